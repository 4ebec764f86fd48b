"""A journal of a few records: the files that say who may read it, and a journalctl that finds them.

It knows --lines= and matches of fields. A match of a field that a record does not have is met, so
tests write only the fields that they are about.
"""

import json
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal import reader
from tests.unit.fakes.manager import UUID
from tests.unit.fakes.programs import make_program

_FIND = """
import json, sys
records, words = sys.argv[1], sys.argv[2:]
given = [one.partition("=") for one in words[words.index("--") + 1 :]] if "--" in words else []
limits = [int(one[8:]) for one in words if one.startswith("--lines=")]
found = []
for line in open(records):
    record = json.loads(line)
    wanted = {}
    for key, _, value in given:
        wanted.setdefault(key, []).append(value)
    if all(key not in record or record[key] in values for key, values in wanted.items()):
        found.append(line)
sys.stdout.writelines(found[: limits[0]] if limits else found)
"""


class FakeJournal:
    """records: newest first."""

    def __init__(self, patch: pytest.MonkeyPatch, root: Path) -> None:
        self._place = root / "journal"
        self._place.mkdir(parents=True, exist_ok=True)
        (self._place / "find.py").write_text(_FIND)
        self.directory = root / "var/log/journal/machine"
        self.directory.mkdir(parents=True, exist_ok=True)
        (self.directory / "system.journal").touch()
        patch.setattr(reader, "ROOT", root)
        patch.setenv("PATH", f"{self._place}:{os.environ['PATH']}")
        self.write()

    def write(self, *records: Mapping[str, Any]) -> None:
        """From now on the journal has these records."""
        self._records.write_text("".join(json.dumps(one) + "\n" for one in records))
        find = f"{sys.executable} -IS {self._place}/find.py {self._records}"
        self._become(f'exec {find} "$@"')

    def complain(self, text: str) -> None:
        """From now on journalctl fails."""
        self._become(f"echo '{text}' >&2; exit 1")

    @property
    def asked(self) -> list[str]:
        """The arguments of each call."""
        calls = self._place / "calls"
        return calls.read_text().splitlines() if calls.exists() else []

    @property
    def _records(self) -> Path:
        return self._place / "records"

    def _become(self, text: str) -> None:
        make_program(self._place / "journalctl", f'echo "$@" >> {self._place}/calls\n{text}')


def life_record(
    event: str, at_us: int, name: str = "robot", uuid: str = UUID, **fields: str
) -> dict[str, str]:
    """The record of a life event, such as "dataflow-failed", that a runner wrote."""
    return {
        "__REALTIME_TIMESTAMP": str(at_us),
        "_SYSTEMD_UNIT": f"dora-{name}.service",
        "DORA_DATAFLOW_NAME": name,
        "DORA_DATAFLOW": uuid,
        "DORA_EVENT": event,
        **fields,
    }


def records_of(*records: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """All of them in one list."""
    return [one for some in records for one in some]

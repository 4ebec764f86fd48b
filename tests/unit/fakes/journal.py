"""A journal of a few records: the files that say who may read it, and a journalctl that finds them.

It knows --lines=, --field=, --output-fields= and matches, see journalctl(1).
"""

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal import reader
from dora_systemd.decisions.logs.query import UNIT_FAILED
from dora_systemd.names import SLICE
from dora_systemd.scope import Scope
from tests.unit.fakes.manager import UUID
from tests.unit.fakes.programs import make_program

SYSTEM = Scope(is_user=False, uid=0)

_FIND = """
import json, sys
records, words = sys.argv[1], sys.argv[2:]
terms, limit = [{}], None
for one in words[words.index("--") + 1 :] if "--" in words else []:
    key, _, value = one.partition("=")
    terms.append({}) if key == "+" else terms[-1].setdefault(key, []).append(value)
limits = [int(one[8:]) for one in words if one.startswith("--lines=")]
fields = [one[8:] for one in words if one.startswith("--field=")]
lines = open(records).readlines()
wanted = [key for one in words if one.startswith("--output-fields=") for key in one[16:].split(",")]

def shown(line):
    if not wanted:
        return line
    kept = [(key, one) for key, one in json.loads(line).items() if key[:2] == "__" or key in wanted]
    return json.dumps(dict(kept)) + "\\n"

if fields:
    print(*{str(json.loads(line)[fields[0]]) for line in lines if fields[0] in line}, sep="\\n")
    sys.exit()
found = [
    line
    for line, record in ((shown(line), json.loads(line)) for line in lines)
    if any(all(record.get(key) in values for key, values in term.items()) for term in terms)
]
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
        self._become(self._find)

    def complain(self, text: str, match: str = "") -> None:
        """From now on journalctl fails. match: only if it is asked for this one."""
        complaint = f"echo '{text}' >&2; exit 1"
        self._become(f'case "$*" in *{match}*) {complaint};; esac\n{self._find}')

    @property
    def asked(self) -> list[str]:
        """The arguments of each call."""
        calls = self._place / "calls"
        return calls.read_text().splitlines() if calls.exists() else []

    @property
    def _find(self) -> str:
        return f'exec {sys.executable} -IS {self._place}/find.py {self._records} "$@"'

    @property
    def _records(self) -> Path:
        return self._place / "records"

    def _become(self, text: str) -> None:
        make_program(self._place / "journalctl", f'echo "$@" >> {self._place}/calls\n{text}')


def life_record(
    event: str,
    at_us: int,
    name: str = "robot",
    uuid: str = UUID,
    scope: Scope = SYSTEM,
    **fields: object,
) -> dict[str, object]:
    """The record of a life event, such as "dataflow-failed", that a runner wrote."""
    kind = "USER_" if scope.is_user else ""
    return {
        "__REALTIME_TIMESTAMP": str(at_us),
        f"_SYSTEMD_{kind}UNIT": f"dora-{name}.service",
        f"_SYSTEMD_{kind}SLICE": SLICE,
        "_UID": str(scope.uid),
        "DORA_DATAFLOW_NAME": name,
        "DORA_DATAFLOW": uuid,
        "DORA_EVENT": event,
        **fields,
    }


def failure_record(at_us: int, name: str, uuid: str) -> dict[str, object]:
    """systemd's own record of the failure of a unit."""
    own = {"_PID": "1", "MESSAGE_ID": UNIT_FAILED, "UNIT": f"dora-{name}.service"}
    return {**own, "DORA_DATAFLOW": uuid, "__REALTIME_TIMESTAMP": str(at_us)}

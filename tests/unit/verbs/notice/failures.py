"""A machine on which a dataflow has failed."""

from pathlib import Path

import pytest

from dora_systemd.decisions.cell.options import RunnerOptions
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import FakeManager
from tests.unit.fakes.programs import make_dora, make_program

SECRET = "hunter2"


def fail(
    manager: FakeManager, patch: pytest.MonkeyPatch, root: Path, options: RunnerOptions
) -> str:
    """Let robot fail, with a secret where none may get into a bundle; its unit is still there."""
    fake_cgroups(patch, root)
    journal = FakeJournal(patch, root)
    more = {"_SYSTEMD_INVOCATION_ID": "1", "_CMDLINE": SECRET, "MESSAGE": "it has ended"}
    failed = {"DORA_EVENT": "dataflow-failed", "DORA_REASON": "node camera: exit code 3"}
    journal.write(
        {**life_record("dataflow-failed", 9), **failed, **more},
        {**life_record("dataflow-starting", 5), **more},
    )
    make_dora(root / "bin/dora", "1.1.0")
    make_program(root / "bin/systemd-analyze")
    patch.setenv("PATH", f"{root}/journal:{root}/bin:/usr/bin:/bin")
    manager.types = {"NRestarts": "u", "Environment": "as", "User": "s"}
    unit = manager.add(options, ActiveState="failed", SubState="failed", User="alice")
    manager.units[unit]["Environment"] = [f"KEY={SECRET}"]
    return unit

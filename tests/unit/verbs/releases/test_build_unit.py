"""The unit of a build does not outlive what waits for it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.releases import build as module
from tests.unit.fakes.manager import FakeManager

UNIT = "doractl-build-robot.service"
BUILD: Any = SimpleNamespace(unit=UNIT, sent=lambda *_: [])


class Silent(FakeManager):
    """A systemd that starts a unit, or queues that, and whose answer does not come."""

    def start_transient(self, unit: str, *_: object, **__: object) -> str:
        self.calls.append(("start", unit))
        self.units[unit] = {"LoadState": "loaded", "ActiveState": "inactive", "Job": (7, "/org")}
        raise DoraSystemdError("cannot start it: no answer")


def open_files() -> set[str]:
    return {one.name for one in Path("/proc/self/fd").iterdir()}


@pytest.mark.parametrize("stop", ["", "cannot stop it"])
def test_a_start_whose_answer_is_lost(monkeypatch: pytest.MonkeyPatch, stop: str) -> None:
    """The unit goes, whether it runs already or not; the first error is told."""
    manager = Silent()
    run_jobs = manager.run_jobs

    def end(*arguments: Any) -> dict[str, str]:
        done = run_jobs(*arguments)
        if stop:
            raise DoraSystemdError(stop)
        return done

    monkeypatch.setattr(manager, "run_jobs", end)
    before = open_files()
    with pytest.raises(DoraSystemdError, match="no answer"):
        module._run(manager, BUILD, BUILD)
    assert manager.calls == [("start", UNIT), ("StopUnit", UNIT)]
    assert open_files() == before

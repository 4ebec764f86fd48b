"""A dry run as root: a unit like the dataflow's, which runs the check and is forgotten."""

import os
from collections.abc import Sequence
from typing import Any

import pytest

from dora_systemd.adapters.bus.manager import Beside, Observer, Property
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.start.check import check_plan
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.start.test_start_unit import make_plan


class CheckingManager(FakeManager):
    """Its units write `said` and end with `status`."""

    def __init__(self, said: bytes = b"", status: int = 0) -> None:
        super().__init__()
        self.said, self.status = said, status
        self.given: dict[str, Any] = {}

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        self.given = {name: value for name, _, value in properties}
        os.write(self.given["StandardOutputFileDescriptor"], self.said)
        self.after_job[unit] = {"ExecMainCode": 1, "ExecMainStatus": self.status}
        return super().start_transient(unit, properties, observer, wait, beside)


@pytest.fixture(autouse=True)
def as_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)


def test_the_unit_of_a_check() -> None:
    manager = CheckingManager()
    check_plan(lambda: manager, make_plan())
    (call,) = [call for call in manager.calls if call[0] == "start"]
    assert call[1].startswith("doractl-check-")
    assert manager.given["Type"] == "oneshot"
    assert manager.given["CollectMode"] == "inactive-or-failed"
    assert manager.given["SystemCallErrorNumber"]
    assert "dora_systemd.runner.check" in manager.given["ExecStart"][0][1]
    for name in ("RuntimeDirectory", "Restart", "ExecStopPostEx", "WatchdogUSec", "LogExtraFields"):
        assert name not in manager.given


def test_what_a_check_refuses() -> None:
    manager = CheckingManager(b"failed: cannot use x: y; hint: z\n", 72)
    with pytest.raises(DoraSystemdError) as caught:
        check_plan(lambda: manager, make_plan())
    error = caught.value
    assert (error.message, error.hint, error.code) == ("cannot use x: y", "z", ExitCode.NO_DORA)


@pytest.mark.parametrize("status", [1, 226])
def test_a_check_that_cannot_be_made(status: int) -> None:
    manager = CheckingManager(b"", status)
    with pytest.raises(DoraSystemdError, match=r"cannot check /srv/robot.yml: .*exit code"):
        check_plan(lambda: manager, make_plan())


def test_the_versions_of_a_check() -> None:
    manager = CheckingManager(b"versions: dora=1.1.0 python=3.13.5\n")
    assert check_plan(lambda: manager, make_plan()) == {"dora": "1.1.0", "python": "3.13.5"}

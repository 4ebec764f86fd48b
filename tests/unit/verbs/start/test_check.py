"""A dry run as root: a unit like the dataflow's, which runs the check and is forgotten."""

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.start.check import check_plan, check_unit
from tests.unit.fakes.manager import PrintingManager
from tests.unit.verbs.start.test_start_unit import make_plan, no_manager


@pytest.fixture(autouse=True)
def as_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)


def test_the_unit_of_a_check() -> None:
    manager = PrintingManager()
    check_plan(lambda: manager, make_plan())
    (call,) = [call for call in manager.calls if call[0] == "start"]
    assert call[1].startswith("doractl-check-")
    assert manager.given["Type"] == "oneshot"
    assert manager.given["CollectMode"] == "inactive-or-failed"
    assert manager.given["SystemCallErrorNumber"]
    assert "dora_systemd.runner.check" in manager.given["ExecStart"][0][1]
    for name in ("RuntimeDirectory", "Restart", "ExecStopPostEx", "WatchdogUSec", "LogExtraFields"):
        assert name not in manager.given


def test_a_failed_check_starts_no_other_unit() -> None:
    """OnFailure= of the dataflow would send a notice of a dataflow that runs."""
    manager, plan = PrintingManager(), make_plan()
    manager.units["doranotice@robot.service"] = {"LoadState": "loaded", "ActiveState": "inactive"}
    options = plan.options.with_value("on_failure", ("/bin/tell",))
    check_plan(lambda: manager, plan._replace(options=options))
    assert "OnFailure" not in manager.given


def test_what_a_check_refuses() -> None:
    manager = PrintingManager(b"failed: cannot use x: y; hint: z\n", 72)
    with pytest.raises(DoraSystemdError) as caught:
        check_plan(lambda: manager, make_plan())
    error = caught.value
    assert (error.message, error.hint, error.code) == ("cannot use x: y", "z", ExitCode.NO_DORA)


@pytest.mark.parametrize("status", [1, 226])
def test_a_check_that_cannot_be_made(status: int) -> None:
    manager = PrintingManager(b"", status)
    with pytest.raises(DoraSystemdError, match=r"cannot check /srv/robot.yml: .*exit code"):
        check_plan(lambda: manager, make_plan())


def test_the_versions_of_a_check() -> None:
    manager = PrintingManager(b"versions: dora=1.1.0 python=3.13.5\n")
    assert check_plan(lambda: manager, make_plan()) == {"dora": "1.1.0", "python": "3.13.5"}


def test_a_dry_run_of_a_user_refuses_what_systemd_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without root the check is no unit, so nothing else compares the plan with systemd."""
    manager, plan = PrintingManager(), make_plan(needs=("network",))
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    with pytest.raises(DoraSystemdError, match="it needs network: a user's manager does not"):
        check_unit(lambda: manager, plan)
    check_unit(no_manager, plan)
    assert manager.calls == []

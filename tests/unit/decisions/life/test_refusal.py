"""A refusal survives its way through STATUS= and the exit status; nothing else passes for one."""

from typing import Any

import pytest

from dora_systemd.decisions.life.refusal import format_refusal, parse_refusal, refusal_exit
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.unit.properties import restart_properties
from dora_systemd.errors import DoraSystemdError, ExitCode, TimedOut
from dora_systemd.verbs.start.start_unit import start_unit
from tests.unit.fakes.manager import FakeManager, options
from tests.unit.verbs.start.test_start_unit import SCOPE, UNIT


@pytest.mark.parametrize("code", [ExitCode.BAD_INPUT, ExitCode.NO_DORA, ExitCode.NO_PERMISSION])
@pytest.mark.parametrize("hint", ["", "correct it; or not"])
def test_there_and_back(code: ExitCode, hint: str) -> None:
    error = DoraSystemdError("cannot use x: y", hint, code)
    back = parse_refusal(format_refusal(error), refusal_exit(error))
    assert back is not None
    assert (back.message, back.hint, back.code) == (error.message, hint, code)


def test_other_errors_are_bad_dataflows() -> None:
    assert refusal_exit(DoraSystemdError("cannot")) is RunnerExit.BAD_DATAFLOW


def test_a_check_without_an_answer_is_no_bad_dataflow() -> None:
    """As on a machine that is busy with its boot: Restart= may try again."""
    status = refusal_exit(TimedOut("cannot wait"))
    assert status is RunnerExit.FAILED
    assert status not in restart_properties(options())["RestartPreventExitStatus"].value[0]


def test_a_line_that_systemd_takes() -> None:
    """At most 4096 bytes without control characters, whatever somebody's dora has printed."""
    for text in ("x" * 9000, "\U0001f600" * 9000, "ä" * 9000):
        line = format_refusal(DoraSystemdError(f"cannot \x1b]52;{text}\x9b\x00", text))
        assert len(f"STATUS={line}".encode()) < 4096
        assert line.isprintable()


@pytest.mark.parametrize(
    ("text", "status"),
    [("starting", 78), ("failed: x", 1), ("failed: x", 0), ("failed: x", 70), ("", 78)],
)
def test_what_is_no_refusal(text: str, status: int) -> None:
    assert parse_refusal(text, status) is None


@pytest.mark.parametrize("wait", [True, False])
def test_a_refused_start_leaves_no_unit(wait: bool) -> None:
    manager = FakeManager()
    manager.add(options(), active="inactive")
    manager.job_results[UNIT] = "failed"
    status = "failed: cannot use /srv/robot.yml: why\x1b[2J; hint: do this"
    facts = {"ActiveState": "failed", "StatusText": status, "ExecMainStatus": 78}
    manager.after_job[UNIT] = facts
    with pytest.raises(DoraSystemdError) as caught:
        start_unit(manager, SCOPE, options(), [], None, wait)
    assert caught.value.message == "cannot use /srv/robot.yml: why\\x1b[2J"
    assert (caught.value.hint, caught.value.code) == ("do this", ExitCode.BAD_INPUT)
    assert UNIT not in manager.units


def test_a_start_that_is_not_waited_for_waits_for_the_first_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manager = FakeManager()
    states: list[dict[str, Any]] = [
        {"ActiveState": "inactive", "Job": [7, "/job"]},
        {"ActiveState": "activating", "StatusText": ""},
        {"ActiveState": "activating", "StatusText": "failed: cannot use x"},
        {"ActiveState": "deactivating", "Job": [0, "/"]},
        {"ActiveState": "failed", "ExecMainStatus": 78, "ExecMainCode": 1},
    ]

    def changes(unit: str) -> list[dict[str, Any]]:
        manager.units[unit] |= states.pop(0)
        return []

    monkeypatch.setattr(manager, "changes", changes)
    manager.add(options(), **states.pop(0))
    manager.after_job[UNIT] = {"ActiveState": "inactive", "Job": [7, "/job"]}
    with pytest.raises(DoraSystemdError, match="cannot use x"):
        start_unit(manager, SCOPE, options(), [], None, wait=False)
    assert not states

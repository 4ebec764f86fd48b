"""Explains why a unit did not start or has failed, from its properties."""

from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.life.causes import UNIT_RESULTS
from dora_systemd.decisions.life.refusal import parse_refusal
from dora_systemd.errors import DoraSystemdError

_PROPERTIES = ("Result", "StatusText", "ExecMainCode", "ExecMainStatus")
_CLD_EXITED = 1
"""ExecMainCode of a process that exited, see waitid(2)."""

_REFUSED = {
    201: "the nice value was refused",
    217: "its user, or the user namespace of its sandbox, could not be set up",
    226: "its sandbox could not be set up",
    243: "a credential could not be read",
    214: "realtime scheduling was refused, see LimitRTPRIO= in systemd.exec(5)",
}
"""Failures of systemd before it executed the runner: exit statuses of systemd.exec(5)."""

_WORDS = {
    **{result: words for result, (_, words) in UNIT_RESULTS.items()},
    "protocol": "its supervisor process ended without a message",
    "timeout": "it did not end in time and was killed",
    "start-limit-hit": "it was started too often",
    "resources": "systemd could not set it up",
    "exec-condition": "a condition was not met",
}


def job_reason(manager: Manager, unit: str, result: str) -> str:
    """Why a start job of `unit` failed; `result`: that of JobRemoved."""
    if result == "canceled":
        return "it was stopped while it started"
    if result == "dependency":
        return "a unit that it needs failed"
    return failure_reason(manager, unit)


def runners_refusal(manager: Manager, unit: str) -> DoraSystemdError | None:
    """The error with which the runner of `unit` refused to start, or None."""
    text = str(manager.read(unit, ["StatusText"])["StatusText"])
    return parse_refusal(text, exit_status(manager, unit) or 0)


def exit_status(manager: Manager, unit: str) -> int | None:
    """The exit status of the main process of `unit`, None if a signal killed it."""
    facts = manager.read(unit, ["ExecMainCode", "ExecMainStatus"])
    return int(facts["ExecMainStatus"]) if facts["ExecMainCode"] == _CLD_EXITED else None


def failure_reason(manager: Manager, unit: str) -> str:
    """One line about the end of `unit`: the runner's last STATUS=, else systemd's result."""
    facts = manager.read(unit, _PROPERTIES)
    special = _WORDS.get(facts["Result"], "")
    last_words = str(facts["StatusText"]).removeprefix(FAILED_BECAUSE)
    if not last_words:
        return special or _exit_words(facts)
    # The runner's own message says more than its exit status.
    is_verdict = last_words != facts["StatusText"]
    cause = special or ("" if is_verdict else _exit_words(facts))
    return f"{last_words} ({cause})" if cause else last_words


def _exit_words(unit: dict[str, Any]) -> str:
    status = unit["ExecMainStatus"]
    if unit["ExecMainCode"] == _CLD_EXITED:
        refused, how = _REFUSED.get(status), exit_of(status)
        return f"{refused} ({how})" if refused else str(how)
    if status:
        return str(exit_of(-status))
    return "ended" if unit["Result"] == "success" else str(unit["Result"])

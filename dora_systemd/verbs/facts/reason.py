"""Explains why a unit did not start or has failed, from its properties."""

import re
from collections.abc import Iterable
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.life.causes import result_words
from dora_systemd.decisions.life.refusal import parse_refusal, setup_failure, without_hint
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import name_from_unit

_PROPERTIES = ("Result", "StatusText", "ExecMainCode", "ExecMainStatus")
_KILLED = ("signal", "core-dump", "watchdog")
"""The Result= of a unit whose main process was killed."""
_NODE = r"node (\S+): "
_CLD_EXITED = 1
"""ExecMainCode of a process that exited, see waitid(2)."""


def job_reason(manager: Manager, unit: str, result: str) -> str:
    """Return why a start job of `unit` failed; `result`: that of JobRemoved."""
    if result == "canceled":
        return "it was stopped while it started"
    if result == "dependency":
        return "a unit that it needs failed"
    return failure_reason(manager, unit)


def logs_hint(flag: str, name: str, reason: str) -> str:
    """Return the hint for a dataflow that failed to start, depending on the reason.

    flag: of the scope. reason: of job_reason().
    """
    more = f"doractl {flag} why {name} shows more"
    found = re.match(_NODE, reason)
    if not found:
        return more
    return f"check logs: doractl {flag} logs {name} --node {found[1]}; {more}"


def need_failure(manager: Manager, flag: str, needed: Iterable[str]) -> tuple[str, str]:
    """Which of the needed units has failed, and where more is found.

    flag: of the scope.
    """
    for unit in needed:
        if manager.read(unit, ["ActiveState"])["ActiveState"] != "active":
            if name := name_from_unit(unit):
                return f"dataflow {name}, which it needs, failed", f"doractl {flag} why {name}"
            return f"{unit}, which it needs, failed", f"systemctl {flag} status {unit}"
    return "a unit that it needs failed", f"systemctl {flag} --failed"


def runners_refusal(manager: Manager, unit: str) -> DoraSystemdError | None:
    """The error with which the runner of `unit` refused to start, or None."""
    text = str(manager.read(unit, ["StatusText"])["StatusText"])
    return parse_refusal(text, exit_status(manager, unit) or 0)


def exit_status(manager: Manager, unit: str) -> int | None:
    """The exit status of the main process of `unit`, None if a signal killed it."""
    facts = manager.read(unit, ["ExecMainCode", "ExecMainStatus"])
    return int(facts["ExecMainStatus"]) if facts["ExecMainCode"] == _CLD_EXITED else None


def failure_reason(manager: Manager, unit: str) -> str:
    """Format the end of `unit` in one line: the runner's last STATUS=, else systemd's result."""
    facts = manager.read(unit, _PROPERTIES)
    special = result_words(facts["Result"])
    last_words = without_hint(str(facts["StatusText"])).removeprefix(FAILED_BECAUSE)
    is_verdict = str(facts["StatusText"]).startswith(FAILED_BECAUSE)
    # A runner that was killed has only reported what it did before, such as "2/2 nodes running".
    if not last_words or (facts["Result"] in _KILLED and not is_verdict):
        return special or _exit_words(facts)
    # The message of the runner explains more than its exit status.
    cause = special or ("" if is_verdict else _exit_words(facts))
    return f"{last_words} ({cause})" if cause else last_words


def _exit_words(unit: dict[str, Any]) -> str:
    status = unit["ExecMainStatus"]
    if unit["ExecMainCode"] == _CLD_EXITED:
        return setup_failure(status) or str(exit_of(status))
    if status:
        return str(exit_of(-status))
    return "ended" if unit["Result"] == "success" else str(unit["Result"])

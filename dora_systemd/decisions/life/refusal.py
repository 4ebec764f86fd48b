"""Passes a runner's refusal to doractl: by its exit status, and by STATUS= of its unit.

With NotifyAccess=main only the runner can set STATUS=, and it refuses before nodes run. But a user
may have another program in the runner's place, so the text is cleaned and cut, and is only printed.
"""

from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.life.states import RunnerExit
from dora_systemd.errors import DoraSystemdError, ExitCode, RestartsSpent, TimedOut
from dora_systemd.terminal_text import short_line

_HINT = "; hint: "
_LONGEST = 1500
"""Maximum bytes of message and hint each: systemd accepts 4096 bytes in a notification."""
_CODES = {
    RunnerExit.BAD_DATAFLOW: ExitCode.BAD_INPUT,
    RunnerExit.NO_ACCESS: ExitCode.NO_PERMISSION,
    RunnerExit.NO_DORA: ExitCode.NO_DORA,
    RunnerExit.NO_MACHINE: ExitCode.NO_HOST,
}


def refusal_exit(error: DoraSystemdError) -> RunnerExit:
    """The runner's exit status for an error; with that of a check without an answer, it restarts.

    A machine that boots may be too busy for one.
    """
    if isinstance(error, TimedOut):
        return RunnerExit.FAILED
    if isinstance(error, RestartsSpent):
        return RunnerExit.RESTARTS_SPENT
    return next(
        (status for status, code in _CODES.items() if code is error.code), RunnerExit.BAD_DATAFLOW
    )


def format_refusal(error: DoraSystemdError) -> str:
    """STATUS= of a runner that refuses its dataflow."""
    hint = f"{_HINT}{short_line(error.hint, _LONGEST)}" if error.hint else ""
    return f"{FAILED_BECAUSE}{short_line(error.message, _LONGEST)}{hint}"


def without_hint(text: str) -> str:
    """STATUS= of a runner, without the hint of a refusal."""
    return text.partition(_HINT)[0]


def parse_refusal(text: str, status: int) -> DoraSystemdError | None:
    """The error that a runner has ended with, None for any other end.

    text: its last STATUS=. status: its exit status.
    """
    if status not in list(_CODES) or not text.startswith(FAILED_BECAUSE):
        return None
    message, _, hint = text.removeprefix(FAILED_BECAUSE).partition(_HINT)
    return DoraSystemdError(
        short_line(message, _LONGEST), short_line(hint, _LONGEST), _CODES[RunnerExit(status)]
    )

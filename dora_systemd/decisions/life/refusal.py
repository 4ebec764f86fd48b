"""How a runner's refusal reaches who started it: its exit status, and STATUS= of its unit.

NotifyAccess=main lets nobody but the runner set that line, and the runner refuses before there are
nodes. A user may still have a runner that lies: so the text is made plain and short, and nothing
is done with it but printing it.
"""

from dora_systemd.decisions.life.states import RunnerExit
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import short_line

FAILED = "failed: "
"""How STATUS= begins once the runner knows why a dataflow failed."""

_HINT = "; hint: "
_LONGEST = 1500
"""Bytes of each of the two: systemd takes 4096 bytes in a notification."""
_CODES = {
    RunnerExit.BAD_DATAFLOW: ExitCode.BAD_INPUT,
    RunnerExit.NO_ACCESS: ExitCode.NO_PERMISSION,
    RunnerExit.NO_DORA: ExitCode.NO_DORA,
}


def refusal_exit(error: DoraSystemdError) -> RunnerExit:
    """The runner's exit status for what it refuses."""
    return next(
        (status for status, code in _CODES.items() if code is error.code), RunnerExit.BAD_DATAFLOW
    )


def format_refusal(error: DoraSystemdError) -> str:
    """STATUS= of a runner that refuses its dataflow."""
    hint = f"{_HINT}{short_line(error.hint, _LONGEST)}" if error.hint else ""
    return f"{FAILED}{short_line(error.message, _LONGEST)}{hint}"


def parse_refusal(text: str, status: int) -> DoraSystemdError | None:
    """The error that a runner has ended with, None for any other end.

    text: its last STATUS=. status: its exit status.
    """
    if status not in list(_CODES) or not text.startswith(FAILED):
        return None
    message, _, hint = text.removeprefix(FAILED).partition(_HINT)
    return DoraSystemdError(
        short_line(message, _LONGEST), short_line(hint, _LONGEST), _CODES[RunnerExit(status)]
    )

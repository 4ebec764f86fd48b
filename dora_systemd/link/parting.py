"""What the head is told when a connection has ended, from ssh's own words."""

from dora_systemd.decisions.machines.wire import Lost, Refused
from dora_systemd.decisions.remote.command import NO_PROGRAM
from dora_systemd.decisions.remote.failures import ending_error, last_line
from dora_systemd.decisions.remote.hosts import parse_host

_FINAL = ("HAS CHANGED", "Host key verification failed", "Permission denied")
"""What no new attempt changes: somebody has to."""


def last_word(host: str, status: int, is_in: bool, said: str, complaint: str) -> Lost | Refused:
    """Whether to try again, or why that is of no use. As ending_error()."""
    error = ending_error(parse_host(host), status, is_in, said, complaint)
    has_no_doractl = is_in and status == NO_PROGRAM and not complaint
    if error and (has_no_doractl or _is_final(is_in, complaint)):
        return Refused(error.message, error.hint)
    words = last_line(_reason(complaint)) or ("" if is_in else last_line(said))
    return Lost(words or (f"exit status {status}" if status else "it has ended"))


def _reason(complaint: str) -> str:
    """What doractl there has said, without its name and its hint."""
    lines = (one.removeprefix("doractl: ") for one in complaint.splitlines())
    return "\n".join(one for one in lines if not one.startswith("hint: "))


def _is_final(is_in: bool, complaint: str) -> bool:
    return not is_in and any(one in complaint for one in _FINAL)

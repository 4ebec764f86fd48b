"""Locks that inhibit restarts: the reasons that are written in the lock file.

The kernel knows who holds a lock. The file only has the reasons, a line "PID TEXT" for each.
"""

from collections.abc import Mapping

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import short_line

MAX_REASON = 200
"""Bytes of a reason that are shown."""
_MAX_DIGITS = 10


def parse_reason(text: str) -> str:
    """A reason as `--why` takes it, in one line. Raises DoraSystemdError (USAGE) if it is empty."""
    reason = short_line(text, MAX_REASON)
    if not reason:
        hint = "such as --why 'it is driving'"
        raise DoraSystemdError("cannot inhibit without a reason", hint, ExitCode.USAGE)
    return reason


def format_reason(pid: int, reason: str) -> bytes:
    """The line of a process in the lock file."""
    return f"{pid} {reason}\n".encode(errors="replace")


def parse_reasons(data: bytes) -> Mapping[int, str]:
    """The reasons in a lock file by pid, the last line of each; other lines do not count.

    A pid is that of the PID namespace in which the process runs, see pid_namespaces(7).
    """
    found = {}
    for line in data.decode(errors="replace").split("\n"):
        pid, _, text = line.partition(" ")
        if pid.isascii() and pid.isdigit() and len(pid) <= _MAX_DIGITS:
            found[int(pid)] = short_line(text, MAX_REASON)
    return found

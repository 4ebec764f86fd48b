"""The one error class, and the exit statuses of doractl."""

import os
from collections.abc import Sequence
from enum import IntEnum

REACHED_AS = "DORACTL_REACHED_AS"
"""The variable with the -H of the caller, for doractl on that host."""


class ExitCode(IntEnum):
    """Exit status of doractl, as doractl(1) lists it.

    3 and 4 are those of systemctl(1), the last two 128 and a signal, as in a shell.
    """

    OK = 0
    FAILURE = 1
    USAGE = 2
    NOT_RUNNING = 3
    NOT_FOUND = 4
    BAD_INPUT = 5
    NAME_IN_USE = 6
    NO_SYSTEMD = 7
    NO_PERMISSION = 8
    NO_DORA = 9
    INHIBITED = 10
    ROLLED_BACK = 11
    NO_HOST = 12
    INTERRUPTED = 130
    PIPE_CLOSED = 141


class DoraSystemdError(Exception):
    """A request of the user that cannot be done.

    message: one line that names the file, key or unit. hint: what to do about it, or "". code: the
    exit status of doractl. lines: the last lines of the node that is the reason, oldest first.
    """

    def __init__(
        self,
        message: str,
        hint: str = "",
        code: ExitCode = ExitCode.FAILURE,
        lines: Sequence[str] = (),
    ) -> None:
        super().__init__(message)
        self.lines = tuple(lines)
        self.message = " ".join(message.split())
        self.hint = " ".join(hint.split())
        self.code = code

    @property
    def is_refused(self) -> bool:
        """Whether the kernel refused the caller a file, so that root could do it."""
        return isinstance(self.__cause__, PermissionError)


def usage_error(message: str, hint: str = "") -> DoraSystemdError:
    """The error for a command line, or a value in it, that is not valid."""
    return DoraSystemdError(message, hint, ExitCode.USAGE)


def bad_input(message: str, hint: str = "") -> DoraSystemdError:
    """The error for a file that is not valid, or that cannot be used."""
    return DoraSystemdError(message, hint, ExitCode.BAD_INPUT)


class WrongKey(DoraSystemdError):
    """A settings file has a wrong key or value. source: its path. place: the keys down to there.

    end: of the message, behind the number of the line.
    """

    def __init__(
        self, message: str, hint: str, source: str, place: Sequence[str], end: str = ""
    ) -> None:
        super().__init__(f"{message}{end}", hint, ExitCode.BAD_INPUT)
        self.source, self.place = source, tuple(place)
        self._begin, self._end = message, end

    def at_line(self, line: int) -> DoraSystemdError:
        """The error with the number of the line, which is 0 if it is not known."""
        where = f" at line {line}" if line else ""
        return DoraSystemdError(f"{self._begin}{where}{self._end}", self.hint, self.code)


class TimedOut(DoraSystemdError):
    """A check took too long, which proves nothing about its subject: a restart may help."""


class RestartsSpent(DoraSystemdError):
    """The automatic restarts of a dataflow are used up: this one would be one too many."""


def words_of(error: Exception) -> str:
    """Return the text of an exception; for one with an errno(3) only the text of that number."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__

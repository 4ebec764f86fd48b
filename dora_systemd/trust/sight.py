"""Checks paths that another user names with that user's permissions: root could see too much.

A child process takes on the account and answers; it runs only the few lines of eyes.py. The account
can stop and trace the child and forge its answers, so callers trust an answer no more than the
account itself. The child may also read nothing and send nothing: so send() and receive() wait no
longer than the caller wants.
"""

import contextlib
import errno
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust import eyes
from dora_systemd.trust.files import MAX_BYTES
from dora_systemd.trust.programs import Account, end_child, spawn
from dora_systemd.values import shell_word, shown

_SECONDS = 5.0
"""Timeout in seconds for all answers together: a mount of the account may hang, and the account may
stop the child."""
_LONGEST = 4096
"""Maximum bytes of a path, see PATH_MAX in limits.h(0p); a longer one may not fit into the pipe."""
_MOST_DIGITS = 4
_MOST_TIME_DIGITS = 20
_HEAD = 8
_CHUNK = 65536


class Sight:
    """The file system as an account sees it, here the caller. All paths are absolute."""

    user = ""
    """The name of another account than the caller."""

    def exists(self, path: str) -> bool:
        return self._is(b"e", path)

    def is_directory(self, path: str) -> bool:
        return self._is(b"d", path)

    def is_program(self, path: str) -> bool:
        """Whether it is an executable program."""
        return self._is(b"x", path)

    def is_writable(self, path: str) -> bool:
        """Whether the account may write it."""
        return self._is(b"w", path)

    def real(self, path: str) -> str:
        """The path with all symbolic links resolved."""
        with contextlib.suppress(OSError):
            found = os.fsdecode(self._ask(b"l", path))
            return found if found.startswith("/") else path
        return path

    def read(self, path: str) -> bytes:
        """The content of a regular file, at most MAX_BYTES + 1 bytes. Raises OSError."""
        return self._ask(b"r", path)

    def head(self, path: str) -> bytes:
        """The first bytes of a regular file. Raises OSError."""
        return self._ask(b"h", path)

    def names(self, prefix: str) -> list[str]:
        """Some names in the directory of `prefix` that begin as its last part."""
        try:
            found = os.fsdecode(self._ask(b"n", prefix))
        except OSError:
            return []
        return [one for one in found.split("\0") if one and "/" not in one and one != ".."]

    def modified_ns(self, path: str) -> int:
        """Return when the file was last written, ns since 1970; 0 without a file."""
        with contextlib.suppress(OSError, ValueError):
            found = self._ask(b"m", path)
            return int(found) if len(found) <= _MOST_TIME_DIGITS else 0
        return 0

    def _is(self, letter: bytes, path: str) -> bool:
        with contextlib.suppress(OSError, ValueError):
            return bool(self._ask(letter, path))
        return False

    def _ask(self, letter: bytes, path: str) -> bytes:
        try:
            return eyes.answer(letter, os.fsencode(path), MAX_BYTES + 1)
        except ValueError as error:  # a path with a null character, as the child reports it, too
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL)) from error


class LentSight(Sight):
    """The file system as another account sees it.

    Each request is sent once, so all that is decided by an answer is decided by the same one.
    Raises DoraSystemdError if its child is silent.
    """

    def __init__(
        self, child: "subprocess.Popen[bytes]", account: Account, seconds: float = _SECONDS
    ) -> None:
        self._child = child
        self._account = account
        self.user = account.name
        self._left = seconds
        self._known: dict[tuple[bytes, str], bytes | int] = {}

    def _ask(self, letter: bytes, path: str) -> bytes:
        """Answer one request. Raises the OSError that the account got."""
        if (letter, path) not in self._known:
            self._known[letter, path] = self._send(letter, path)
        answer = self._known[letter, path]
        if isinstance(answer, int):
            raise OSError(answer, os.strerror(answer))
        return answer

    def _send(self, letter: bytes, path: str) -> bytes | int:
        """Send one request to the child; return its answer, or the number of an error."""
        assert self._child.stdin and self._child.stdout
        question = os.fsencode(path)
        if len(question) > _LONGEST:
            return errno.ENAMETOOLONG
        begun = time.monotonic()
        deadline = begun + self._left
        try:
            asked, told = self._child.stdin.fileno(), self._child.stdout.fileno()
            send(asked, b"%s%07d%s" % (letter, len(question), question), deadline)
            head = receive(told, _HEAD, deadline)
            data = receive(told, min(int(head[1:]), MAX_BYTES + 1), deadline)
        except (BrokenPipeError, ValueError) as error:
            message = f"cannot look at {shown(path)} as user {self._account.name}: no answer"
            raise DoraSystemdError(message, "see whether a mount of that user hangs") from error
        finally:
            self._left -= time.monotonic() - begun
        if head[:1] != b"+":
            is_number = data.isdigit() and len(data) <= _MOST_DIGITS
            return int(data) if is_number else errno.EINVAL
        return data


@contextlib.contextmanager
def sight_of(account: Account | None, seconds: float = _SECONDS) -> Iterator[Sight]:
    """Open the Sight of an account; that of the caller for None, or if the caller is not root.

    seconds: timeout for all answers together. Raises DoraSystemdError (NO_PERMISSION) if the
    account cannot execute our Python interpreter.
    """
    if account is None or account.uid == os.geteuid() or os.geteuid() != 0:
        yield Sight()
        return
    text = Path(eyes.__file__).read_text(encoding="utf-8")
    command = (sys.executable, "-I", "-S", "-c", text, str(MAX_BYTES + 1))
    child = start_reader(command, account)
    try:
        yield LentSight(child, account, seconds)
    finally:
        end_child(child)


def start_reader(
    command: Sequence[str], account: Account, directory: str = "/"
) -> "subprocess.Popen[bytes]":
    """Start our interpreter as the account, to read for us by its standard input and output.

    directory: where it starts; the caller has to reach it, not the account. Raises
    DoraSystemdError (NO_PERMISSION) if the account cannot execute it.
    """
    try:
        return spawn(
            command, account, directory=directory, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
    except OSError as error:
        raise cannot_reach(account.name, sys.executable) from error


def cannot_reach(user: str, path: str) -> DoraSystemdError:
    """The error for a path that the user of a dataflow cannot access."""
    message = f"cannot start the dataflow as user {user}, who cannot reach {shown(path)}"
    way = "move it, chmod a+rX what is closed, or choose another user with --uid"
    hint = f"see namei -l {shell_word(path)}: {way}"
    return DoraSystemdError(message, hint, ExitCode.NO_PERMISSION)


def send(fd: int, data: bytes, deadline: float) -> None:
    """Write all data to the pipe `fd` until `deadline` (seconds of the monotonic clock).

    Raises BrokenPipeError if the reader does not take the data in time.
    """
    os.set_blocking(fd, False)  # a pipe has 64 KiB
    while data:
        _wait(fd, select.POLLOUT, deadline)
        data = data[os.write(fd, data) :]


def receive(fd: int, count: int, deadline: float) -> bytes:
    """Exactly `count` bytes of the pipe `fd`, until `deadline`.

    Raises BrokenPipeError if they do not come in time, or the pipe ends before.
    """
    received = bytearray()
    while len(received) < count:
        _wait(fd, select.POLLIN, deadline)
        chunk = os.read(fd, min(count - len(received), _CHUNK))
        if not chunk:
            raise BrokenPipeError
        received += chunk
    return bytes(received)


def _wait(fd: int, event: int, deadline: float) -> None:
    # Not select(2): the gateway may have more file descriptors than that can take.
    poll = select.poll()
    poll.register(fd, event)
    if not poll.poll(max(deadline - time.monotonic(), 0) * 1000):
        raise BrokenPipeError

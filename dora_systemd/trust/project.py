"""Reads a project with the permissions of the user that its nodes will run as.

Root copies what another user owns. A child process that is that user reads it, see courier.py: so a
release contains nothing that its nodes could not read before, and git and whatever the repository
configures never run as root. That user can trace the child and make it lie, so every answer is
bounded and checked on arrival, and so is the time for all of them.
"""

import contextlib
import json
import os
import posixpath
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import cut
from dora_systemd.trust import courier
from dora_systemd.trust.programs import Account, account_of_uid, end_child
from dora_systemd.trust.sight import receive, send, start_reader
from dora_systemd.values import shown

_SECONDS = 90.0
"""Timeout for each frame: git has 60 s, and a mount of the user may hang."""
_TOTAL_SECONDS = 300.0
_BYTES_PER_SECOND = 512 * 1024
_SECONDS_PER_FILE = 0.05
"""The child has all of these together: a byte for each frame must not hold root's lock for ever."""
_HEAD = 8
MOST_ANSWER = 64 * 1024 * 1024
"""Maximum bytes of an answer that is not the content of a file."""
_LONGEST_LINE = 256 * 1024
"""Maximum bytes of a line of an answer: JSON of many small values takes 20 times its size."""
_BATCH = 500
_MOST_SIZE = 2**63
_SHORT = 500
"""Maximum length of a path in an error."""
_LONGEST = 4096
"""Maximum length of a text about a file, see PATH_MAX in limits.h(0p)."""


class Patience:
    """The total time to wait for a child. left: seconds, which the child earns by sending data.

    most: seconds for each frame.
    """

    def __init__(self, left: float = _TOTAL_SECONDS, most: float = _SECONDS) -> None:
        self.left = left
        self._most = most

    @contextlib.contextmanager
    def waiting(self) -> Iterator[float]:
        """Measure the block, and yield its deadline. Raises BrokenPipeError if no time is left."""
        if self.left <= 0:
            raise BrokenPipeError
        begun = time.monotonic()
        try:
            yield begun + min(self._most, self.left)
        finally:
            self.left -= time.monotonic() - begun

    def earn(self, size: int = 0, files: int = 0) -> None:
        """Add the time that a slow disk needs for so many bytes, and for so many files."""
        self.left += size / _BYTES_PER_SECOND + files * _SECONDS_PER_FILE


class Project:
    """The files of a project, as an account sees them. root: its absolute path."""

    def __init__(self, root: str, child: "subprocess.Popen[bytes]", account: Account) -> None:
        self.root = root
        self.patience = Patience()
        self._child = child
        self._account = account

    def listed(self, directory: str, most: int) -> list[list[Any]]:
        """The facts of at most `most` entries of a directory, see courier.facts()."""
        return self._entries({"ask": "list", "path": directory, "most": most})

    def walked(self, directory: str, most: int, always: Sequence[str]) -> list[list[Any]]:
        """Return what listed() returns, without what .gitignore files or `always` leave out.

        Call walked() for a directory before its subdirectories, which its .gitignore concerns, too.
        """
        rules = {"always": list(always), "libraries": _libraries()}
        ignore_file = courier.joined(directory, courier.IGNORE_FILE)
        asked = {"ask": "walk", "path": directory, "most": most, "paths": [ignore_file]}
        return self._entries({**asked, **rules})

    def _entries(self, request: dict[str, Any]) -> list[list[Any]]:
        directory, most = request["path"], request["most"]
        values = self._values(request, directory, most)
        rows = [self._row(value, directory) for value in values]
        if any(posixpath.dirname(row[0]) != directory for row in rows):
            raise self._broken(directory)
        return rows

    def facts(self, paths: Sequence[str], opens: bool = False) -> list[list[Any] | None]:
        """The facts of these files, None for one that is not there. opens: see courier.facts()."""
        found: list[list[Any] | None] = []
        for start in range(0, len(paths), _BATCH):
            part = paths[start : start + _BATCH]
            asked = {"ask": "facts", "paths": list(part), "opens": opens}
            values = self._values(asked, part[0], len(part))
            rows = [None if one is None else self._row(one, part[0]) for one in values]
            if len(rows) != len(part):
                raise self._broken(part[0])
            if any(row and row[0] != one for one, row in zip(part, rows, strict=True)):
                raise self._broken(part[0])
            found += rows
        return found

    def read(self, path: str) -> Iterator[bytes]:
        """The content of a file. Raises DoraSystemdError; the caller bounds its length."""
        yield from self._ask({"ask": "read", "path": path}, path)

    def tracked(self, owners: Sequence[int], most: int) -> tuple[list[str] | None, str]:
        """The files that git would track, None without git, and the revision, "" without one.

        owners: of a repository that git may read although the account does not own it.
        """
        asked = {"ask": "git", "owners": list(owners), "most": most}
        texts = list(map(self._text, self._values(asked, ".git", most + 1)))
        return (texts[1:], texts[0]) if texts else (None, "")

    def _text(self, value: Any) -> str:
        if not _is_text(value):
            raise self._broken(".git")
        return str(value)

    def _row(self, row: Any, path: str) -> list[Any]:
        types = (str, str, int, bool, str, str, int)
        is_sound = (
            isinstance(row, list)
            and len(row) == len(types)
            and all(type(one) is kind for one, kind in zip(row, types, strict=True))
            and 0 <= row[2] < _MOST_SIZE
            and all(_is_text(one) for one in row if isinstance(one, str))
        )
        if not is_sound:
            raise self._broken(path)
        return list(row)

    def _values(self, request: dict[str, Any], path: str, most: int) -> Iterator[Any]:
        """The values in the lines of an answer, one by one, so that no more is in memory."""
        rest, size, count = b"", 0, 0
        for part in self._ask(request, path):
            *lines, rest = (rest + part).split(b"\n")
            size, count = size + len(part), count + len(lines)
            if size > MOST_ANSWER or count > most or len(rest) > _LONGEST_LINE:
                raise self._broken(path)
            try:
                yield from map(json.loads, lines)
            except (ValueError, RecursionError) as error:
                raise self._broken(path) from error
        if rest:
            raise self._broken(path)

    def _ask(self, request: dict[str, Any], path: str) -> Iterator[bytes]:
        assert self._child.stdin
        try:
            self.patience.earn(files=1 + len(request.get("paths", ())))
            with self.patience.waiting() as deadline:
                send(self._child.stdin.fileno(), json.dumps(request).encode() + b"\n", deadline)
            while (frame := self._frame())[0] == b"+":
                yield frame[1]
        except (BrokenPipeError, ValueError) as error:
            raise self._broken(path) from error
        if frame[0] != b".":
            reason, _, place = frame[1].decode("utf-8", "surrogateescape").partition("\n")
            path = place if place in request.get("paths", ()) else path
            hint = "let that user read it, or name it in .gitignore"
            raise self._refusal(path, shown(reason[:200]), hint, ExitCode.BAD_INPUT)

    def _frame(self) -> tuple[bytes, bytes]:
        assert self._child.stdout
        fd = self._child.stdout.fileno()
        with self.patience.waiting() as deadline:
            head = receive(fd, _HEAD, deadline)
            if not head[1:].isdigit() or int(head[1:]) > courier.CHUNK:
                raise ValueError(head)
            if head[:1] == b"+" and not int(head[1:]):
                raise ValueError(head)  # else an answer could have no end
            data = receive(fd, int(head[1:]), deadline)
        self.patience.earn(size=len(data))
        return head[:1], data

    def _broken(self, path: str) -> DoraSystemdError:
        hint = "see whether a mount of that user hangs"
        reason = "no answer" if self.patience.left > 0 else "it takes too long"
        return self._refusal(path, reason, hint, ExitCode.FAILURE)

    def _refusal(self, path: str, reason: str, hint: str, code: ExitCode) -> DoraSystemdError:
        place = cut(shown(str(Path(self.root, path))), _SHORT)
        return DoraSystemdError(
            f"cannot read {place} as user {self._account.name}: {reason}", hint, code
        )


def _libraries() -> str:
    """Return the directory with pathspec, which the child's interpreter does not search."""
    found = find_spec("pathspec")
    assert found and found.origin
    return str(Path(found.origin).parents[1])


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST


@contextlib.contextmanager
def opened_project(
    root: str, account: Account | None, place: str | None = None, program: str = courier.__file__
) -> Iterator[Project]:
    """The project in the directory `root` as the account sees it; None: as the caller does.

    place: where its files are instead, in a directory that the account could not reach. program:
    what the child runs. Raises DoraSystemdError (NO_PERMISSION) if the account cannot execute our
    Python interpreter.
    """
    account = account or account_of_uid(os.geteuid())
    text = Path(program).read_text(encoding="utf-8")
    command = (sys.executable, "-I", "-S", "-c", text, "." if place else root)
    child = start_reader(command, account, place or "/")
    try:
        yield Project(root, child, account)
    finally:
        # With its git, if that hangs: the child is the leader of its process group.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        end_child(child)

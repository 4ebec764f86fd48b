"""Reads a project for a release, as the account that runs this.

It imports the standard library only, and pathspec once rules of gitignore(5) are to be matched: a
pattern can take for ever, so that is done where it can be killed, and never as root.

project.py has a child process of that account run the text of this file. Requests are lines of
JSON. An answer is frames: a letter, a length as 7 digits, and that many bytes; "+" has data, "."
ends an answer, "-" ends it with the reason of a failure. All paths are relative to the project.
An answer that is not the content of a file has lines of JSON, so that parts of it can be checked.
"""

import contextlib
import json
import os
import re
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

CHUNK = 256 * 1024
_GIT_SECONDS = 60
MOST_PRINTED = 64 * 1024 * 1024
"""Maximum bytes that git may print."""
IGNORE_FILE = ".gitignore"
MOST_RULES = 1024 * 1024
"""Maximum bytes of a .gitignore."""
_KINDS = {
    **{stat.S_IFREG: "file", stat.S_IFLNK: "link", stat.S_IFDIR: "directory"},
    **{stat.S_IFIFO: "FIFO", stat.S_IFSOCK: "socket"},
    **dict.fromkeys((stat.S_IFBLK, stat.S_IFCHR), "device"),
}
# No program that a repository's configuration names has to run for these questions.
_GIT = (
    *("git", "-c", "core.fsmonitor=false", "-c", "core.hooksPath=/dev/null"),
    *("-c", "core.untrackedCache=false"),
)
_OPEN = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def facts(path: str, opens: bool = False) -> list[Any] | None:
    """Path, kind, size, whether it is executable, target, signature and time of the last change.

    None for nothing. opens: open the file, as then a network file system requests its times of the
    server. Raises OSError.
    """
    try:
        found = opened_status(path) if opens else Path(path).lstat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    kind = _KINDS.get(stat.S_IFMT(found.st_mode), "special file")
    target = str(Path(path).readlink()) if kind == "link" else ""
    is_executable = bool(found.st_mode & stat.S_IXUSR)
    own = (path, kind, found.st_size, is_executable, target)
    return [*own, signature(found), found.st_ctime_ns]


def opened_status(path: str) -> os.stat_result:
    """Open a file, and return its status. Raises OSError."""
    fd = os.open(path, _OPEN)
    try:
        return os.fstat(fd)
    finally:
        os.close(fd)


def signature(found: os.stat_result) -> str:
    """Numbers of which one differs after a change, unless a program sets the time back."""
    return f"{found.st_ino} {found.st_size} {found.st_mtime_ns} {found.st_mode}"


def listed(path: str, most: int, rules: "Rules | None" = None) -> list[Any]:
    """The facts of at most `most` entries of a directory, without those that rules leave out."""
    with os.scandir(path or ".") as entries:
        known = (entry for entry in entries if rules is None or not rules.ignore(path, entry))
        names = sorted(entry.name for entry in islice(known, most))
    return [one for one in (facts(joined(path, name)) for name in names) if one]


def joined(directory: str, name: str) -> str:
    """The path of a file; "" is the project itself."""
    return f"{directory}/{name}" if directory else name


class Rules:
    """Files that a release leaves out: `always` anywhere, and what each .gitignore lists.

    libraries: the directory that has pathspec.
    """

    def __init__(self, libraries: str, always: list[str]) -> None:
        sys.path.append(libraries)
        self._always, self._own = self._spec(always), dict[str, Any]()

    @staticmethod
    def _spec(lines: list[str]) -> Any:
        """Parse all valid patterns among the lines; an invalid line matches nothing, as in git."""
        from pathspec import GitIgnoreSpec

        sound = []
        for line in lines:
            with contextlib.suppress(ValueError, re.error):
                GitIgnoreSpec.from_lines([line])
                sound.append(line)
        return GitIgnoreSpec.from_lines(sound)

    def enter(self, directory: str) -> None:
        """Take the .gitignore of a directory, if there is one. Raises OSError."""
        path = joined(directory, IGNORE_FILE)
        prefix = joined(directory, "")
        self._own.pop(prefix, None)
        found = facts(path)
        if found is None or found[1] != "file":
            return
        data = b"".join(islice(content(path), MOST_RULES // CHUNK + 1))
        if len(data) > MOST_RULES:
            raise OSError(0, "too large", path)
        lines = data.decode(errors="replace").splitlines()
        self._own[prefix] = self._spec(lines)

    def ignore(self, directory: str, entry: "os.DirEntry[str]") -> bool:
        """Return whether a release leaves out an entry of a directory."""
        path = joined(directory, entry.name)
        path += "/" if entry.is_dir(follow_symlinks=False) else ""
        return bool(self._always.match_file(path)) or any(
            path.startswith(prefix) and spec.match_file(path[len(prefix) :])
            for prefix, spec in self._own.items()
        )


def content(path: str) -> Iterator[bytes]:
    """The content of a regular file."""
    fd = os.open(path, _OPEN)
    with os.fdopen(fd, "rb", buffering=0) as file:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            raise OSError(0, "not a regular file")
        while chunk := file.read(CHUNK):
            yield chunk


def git(command: tuple[str, ...], safe: str) -> bytes | None:
    """Return the output of a git command, None if it fails."""
    trusted = ("-c", f"safe.directory={safe}") if safe else ()
    # A hook of git has variables that lead to another repository.
    own = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        child = subprocess.Popen(
            [*_GIT, *trusted, *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**own, "GIT_OPTIONAL_LOCKS": "0", "LC_ALL": "C"},
        )
    except OSError:
        return None
    return printed(child)


def printed(
    child: "subprocess.Popen[bytes]", seconds: float = _GIT_SECONDS, most: int = MOST_PRINTED
) -> bytes | None:
    """Return the output of a child, None if it fails or is late. Raises OSError for too much."""
    assert child.stdout
    late = threading.Timer(seconds, child.kill)
    late.start()
    try:
        with child:
            data = child.stdout.read(most + 1)
            if len(data) > most:
                child.kill()
    finally:
        late.cancel()
    if len(data) > most:
        raise OSError(0, "git lists too many files")
    return None if child.returncode else data


def repository(owners: list[int]) -> str:
    """The directory above, or at the project, with a .git, if one of `owners` owns both, or ""."""
    here = Path.cwd()
    for place in (here, *here.parents):
        try:
            found = {place.lstat().st_uid, (place / ".git").lstat().st_uid}
        except OSError:
            continue
        return str(place) if found <= {*owners} else ""
    return ""


def tracked(owners: list[int], most: int) -> list[str]:
    """The revision, "" without one, and the files that git would track; [] without git.

    Without owners git is not called.
    """
    if not owners:
        return []
    safe = repository(owners)
    names = git(("ls-files", "-z", "--cached", "--others", "--exclude-standard"), safe)
    if not names:  # nor if a git above ignores all of it
        return []
    about = git(("describe", "--always", "--abbrev=7", "--dirty=+", "--exclude=*"), safe)
    files = [os.fsdecode(one) for one in names.split(b"\0") if one]
    return [os.fsdecode(about or b"").strip(), *sorted({*files})[:most]]


@cache
def rules_of(libraries: str, *always: str) -> Rules:
    """The rules of this process, which it gathers on its way down."""
    return Rules(libraries, [*always])


def answer(request: dict[str, Any]) -> Iterator[bytes]:
    """The data of an answer. Raises OSError."""
    what = request["ask"]
    if what == "read":
        yield from content(request["path"])
    elif what == "list":
        yield from lines(listed(request["path"], request["most"]))
    elif what == "walk":
        rules = rules_of(request["libraries"], *request["always"])
        rules.enter(request["path"])
        yield from lines(listed(request["path"], request["most"], rules))
    elif what == "facts":
        yield from lines([facts(one, request["opens"]) for one in request["paths"]])
    elif what == "git":
        yield from lines(tracked(request["owners"], request["most"]))


def lines(values: Sequence[Any]) -> Iterator[bytes]:
    """The values, a line of JSON for each."""
    if values:
        yield b"".join(json.dumps(one).encode() + b"\n" for one in values)


def frame(letter: bytes, data: bytes = b"") -> None:
    """Write frames with this data."""
    for start in range(0, len(data) or 1, CHUNK):
        part = data[start : start + CHUNK]
        sys.stdout.buffer.write(b"%s%07d%s" % (letter, len(part), part))


def reason(error: OSError | ValueError) -> bytes:
    """Format why a request failed, and in a second line the path."""
    text = str(getattr(error, "strerror", None) or error)[:200]
    path = getattr(error, "filename", None)
    return f"{text}\n{path if isinstance(path, str) else ''}".encode("utf-8", "surrogateescape")


def main(root: str) -> None:
    """Answer requests about the project `root` until the end of standard input."""
    is_there = False
    for line in sys.stdin.buffer:
        try:
            if not is_there:
                os.chdir(root)
                is_there = True
            for data in answer(json.loads(line)):
                frame(b"+", data)
            frame(b".")
        except (OSError, ValueError) as error:
            frame(b"-", reason(error))
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(sys.argv[1])

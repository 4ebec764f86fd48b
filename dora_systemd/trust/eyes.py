"""Checks paths for a Sight; imports the standard library only.

sight.py calls answer() for the caller. For another user, sight.py has a child process of that user
run the text of this file: that user may not be able to read our package.
"""

import errno
import itertools
import os
import stat
import sys

_PART = 32 * 1024
_HEAD = 256
"""Bytes at the head of a program that determine how the kernel executes it."""
_MOST_ENTRIES = 10_000
_MOST_NAMES = 16


def check_regular(mode: int) -> None:
    """Raise OSError unless `mode` is that of a regular file."""
    if not stat.S_ISREG(mode):
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.ENXIO
        raise OSError(number, os.strerror(number))


def read_regular(path: str | bytes | os.PathLike[str], most: int) -> bytes:
    """The content of a regular file, at most `most` bytes. Raises OSError."""
    # O_NONBLOCK: opening a FIFO would wait for a writer. O_NOCTTY: nor become our terminal.
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        check_regular(os.fstat(fd).st_mode)
        return _read(fd, most)
    finally:
        os.close(fd)


def _read(fd: int, most: int) -> bytes:
    # In parts: a read gets memory for all that it may return, however little the file has.
    parts = []
    while most > 0 and (part := os.read(fd, min(most, _PART))):
        parts.append(part)
        most -= len(part)
    return b"".join(parts)


def answer(letter: bytes, path: bytes, most: int) -> bytes:
    """The answer to one question of a Sight; b"" is "no". Raises OSError and ValueError."""
    if letter == b"l":
        return os.path.realpath(path)
    if letter == b"r":
        return read_regular(path, most)
    if letter == b"h":
        return read_regular(path, _HEAD)
    if letter == b"n":
        return b"\0".join(_names(path))
    found = os.stat(path)  # noqa: PTH116 - a Path has no bytes
    if letter == b"m":
        return b"%d" % found.st_mtime_ns
    mode = found.st_mode
    is_so = {
        b"e": True,
        b"d": stat.S_ISDIR(mode),
        b"x": stat.S_ISREG(mode) and os.access(path, os.X_OK),
        b"w": os.access(path, os.W_OK),
    }
    return b"1" if is_so[letter] else b""


def _names(prefix: bytes) -> list[bytes]:
    """The first names in a directory that begin as the last part of `prefix`."""
    directory, _, begin = prefix.rpartition(b"/")
    with os.scandir(directory or b"/") as entries:
        some = itertools.islice(entries, _MOST_ENTRIES)
        found = (one.name for one in some if one.name.startswith(begin))
        return list(itertools.islice(found, _MOST_NAMES))


def main(most: int) -> None:
    """Answer questions until the end of standard input.

    Questions and answers are a letter, the length as 7 digits, and that many bytes.
    """
    while head := sys.stdin.buffer.read(8):
        path = sys.stdin.buffer.read(int(head[1:]))
        try:
            kind, data = b"+", answer(head[:1], path, most)
        except (OSError, ValueError) as error:
            kind, data = b"-", b"%d" % (getattr(error, "errno", 0) or errno.EINVAL)
        sys.stdout.buffer.write(b"%s%07d%s" % (kind, len(data), data))
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))

"""Replaces a file in one step; imports the standard library only.

owned.py calls replace_text() for the caller. For another user, owned.py has a child process of that
user run the text of this file.
"""

import contextlib
import errno
import os
import stat
import sys

_NEW_MODE = 0o644
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_CHANGED = "it was changed meanwhile"
_ACL = "system.posix_acl_access"
"""The extended attribute that has the ACL of a file, see acl(5)."""
HEAD = 8
"""Digits of the length before each text."""


def replace_text(path: str, before: bytes, after: bytes) -> None:
    """Replace the content of a file in one step, durably; create it if `before` is empty.

    Raises OSError, also if it has another content than `before`.
    """
    directory, _, name = path.rpartition("/")
    parent = os.open(directory or "/", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    temporary = f".{name}.{os.urandom(4).hex()}"
    try:
        mode, group, acl = _checked(parent, name, before)
        fd = os.open(temporary, _NEW, 0o600, dir_fd=parent)
        try:
            with os.fdopen(fd, "wb") as file:
                _give(fd, mode, group, acl)
                file.write(after)
                file.flush()
                os.fsync(fd)
            os.rename(temporary, name, src_dir_fd=parent, dst_dir_fd=parent)
        except OSError:
            os.unlink(temporary, dir_fd=parent)
            raise
        os.fsync(parent)
    finally:
        os.close(parent)


def _give(fd: int, mode: int, group: int, acl: bytes) -> None:
    """Give a new file the mode, the group and the ACL of the file that it replaces."""
    with contextlib.suppress(OSError):  # one that its directory has given it
        os.removexattr(fd, _ACL)
    try:
        os.fchown(fd, -1, group)
    except OSError as error:
        if acl:
            raise OSError(0, "its ACL cannot be kept without its group") from error
        # Its owner is not in that group. Another group gets no more than all users have.
        mode = mode & ~stat.S_IRWXG | (mode & stat.S_IRWXO) << 3
    os.fchmod(fd, mode)
    if acl:
        os.setxattr(fd, _ACL, acl)


def _acl_of(fd: int) -> bytes:
    """The ACL of a file, b"" without one."""
    with contextlib.suppress(OSError):
        return os.getxattr(fd, _ACL)
    return b""


def _checked(parent: int, name: str, before: bytes) -> tuple[int, int, bytes]:
    """The mode, the group and the ACL of the file. Raises OSError if it is not as it was read."""
    try:
        fd = os.open(name, _READ, dir_fd=parent)
    except FileNotFoundError:
        if before:
            raise
        return _NEW_MODE, -1, b""
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(0, "it is a symbolic link") from error
        raise
    with os.fdopen(fd, "rb", buffering=0) as file:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(0, "it is not a regular file")
        if file.read(len(before) + 1) != before:
            raise OSError(0, _CHANGED)
        if not status.st_mode & stat.S_IWUSR:
            raise OSError(0, "it is read-only")
        return stat.S_IMODE(status.st_mode), status.st_gid, _acl_of(fd)


def main(path: str) -> None:
    """Replace a file by what standard input has; print the reason of a failure with its length."""
    before, after = (sys.stdin.buffer.read(int(sys.stdin.buffer.read(HEAD))) for _ in range(2))
    reason = ""
    try:
        replace_text(path, before, after)
    except OSError as error:
        reason = str(error.strerror or error)[:200]
    data = reason.encode()
    sys.stdout.buffer.write(b"%08d%s" % (len(data), data))


if __name__ == "__main__":
    main(sys.argv[1])

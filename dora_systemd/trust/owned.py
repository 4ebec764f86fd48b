"""Replaces a file that another user may own: with that user's permissions, never with root's.

Root's own files, which nobody else can place or change, are written by the caller. For the file of
another user a child process of that user writes, see scribe.py. If that user has put a link or
another file there meanwhile, only that user's own files are at stake.
"""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust import scribe
from dora_systemd.trust.paths import Place
from dora_systemd.trust.programs import account_of_uid, end_child, spawn
from dora_systemd.trust.sight import receive, send
from dora_systemd.values import shown

_SECONDS = 30.0
_REFUSALS = (os.strerror(errno.EACCES), os.strerror(errno.EPERM))
_LONGEST = 200
"""Maximum bytes of a reason: that user can send any text, which the edge of doractl escapes."""


def writer_of(place: Place) -> int:
    """The uid for replace_file(): the owner of a file, or of a directory above a file of root.

    That directory can become a link while root writes. Raises DoraSystemdError (NO_PERMISSION) if
    several users could do that.
    """
    strangers = sorted(place.owners - {0})
    if place.uid or not place.borrowed or os.geteuid() != 0:
        return place.uid
    if len(strangers) > 1 or place.shared:
        message = f"cannot write {shown(place.path)}: {place.borrowed}"
        raise DoraSystemdError(message, "nothing is changed", ExitCode.NO_PERMISSION)
    return strangers[0]


def replace_file(path: str, before: bytes, after: bytes, owner: int) -> None:
    """Replace a file as scribe.replace_text() does, with the permissions of its owner.

    owner: its uid; of a new file that of the file next to it. Root becomes that user, and other
    callers need no more than their own permissions. Raises DoraSystemdError.
    """
    try:
        if os.geteuid() != 0 or owner == 0:
            scribe.replace_text(path, before, after)
        else:
            _as_user(path, before, after, owner)
    except OSError as error:
        code = ExitCode.NO_PERMISSION if isinstance(error, PermissionError) else ExitCode.FAILURE
        message = f"cannot write {shown(path)}: {error.strerror}"
        raise DoraSystemdError(message, "nothing is changed", code) from error


def _as_user(path: str, before: bytes, after: bytes, owner: int) -> None:
    text = Path(scribe.__file__).read_text(encoding="utf-8")
    program = (sys.executable, "-I", "-S", "-c", text, path)
    account = account_of_uid(owner)
    child = spawn(program, account, directory="/", stdin=subprocess.PIPE)
    assert child.stdin and child.stdout
    deadline = time.monotonic() + _SECONDS
    try:
        frames = b"".join(b"%08d%s" % (len(one), one) for one in (before, after))
        send(child.stdin.fileno(), frames, deadline)
        size = int(receive(child.stdout.fileno(), scribe.HEAD, deadline))
        reason = receive(child.stdout.fileno(), min(size, _LONGEST), deadline)
    except (BrokenPipeError, ValueError) as error:
        raise OSError(0, f"no answer of user {account.name}") from error
    finally:
        end_child(child)
    if reason:
        text = reason.decode("utf-8", "replace")
        raise (PermissionError if text in _REFUSALS else OSError)(0, text)

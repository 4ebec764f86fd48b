"""A child process that finishes the work of this process if this process is killed, as by SIGKILL.

The out-of-memory killer, too, kills one process without a notice. The child learns of the kill by
the end of a connection, which the kernel closes. The child holds the lock of its parent, see
flock(2), so no other process takes the lock before the work is finished. The child has its own
session, and ignores all signals that can be ignored: only SIGKILL to the whole cgroup ends parent
and child, and then the next command has to finish the work.

A transient unit with ExecStopPost= cannot replace it. Such a unit cannot hold the lock: another
command could change the same files first. The work would need a Python of its own, which takes 0.2
to 0.3 s to load it, and its arguments in the text of the unit, which all users can read.
"""

import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that request the end of a process, and usually of its whole process group or unit."""
_MORE = (signal.SIGQUIT, signal.SIGABRT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM)
"""More such signals, of a unit (see KillSignal= in systemd.kill(5)) or a terminal. They end this
process, as the caller wants; the child ignores them."""

_WORD = b"."


@contextmanager
def guarded(end: Callable[[], None], lock: Path) -> Iterator[None]:
    """Call `end` in another process if this one is killed in the block.

    lock: the only open file that the child keeps, and so the lock that it continues to hold.
    """
    ours, theirs = socket.socketpair()
    child = os.fork()
    if not child:
        ours.close()
        _guard(theirs, end, lock)
    theirs.close()
    try:
        ours.recv(1)  # it is out of reach of what ends this process group
        yield
    finally:
        with suppress(BrokenPipeError):
            ours.send(_WORD)
        ours.close()
        os.waitpid(child, 0)


def _guard(parent: socket.socket, end: Callable[[], None], lock: Path) -> NoReturn:
    status = 1
    try:
        os.setsid()
        _close_others(parent.fileno(), lock)
        for one in (*SIGNALS, *_MORE):
            signal.signal(one, signal.SIG_IGN)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):  # a reader of our output must not wait for the child
            os.dup2(nowhere, stream)
        parent.send(_WORD)
        if not parent.recv(1):
            end()
        status = 0
    finally:
        os._exit(status)


def _close_others(kept: int, lock: Path) -> None:
    """Close what belongs to others: their connections, and the locks of other guards' parents."""
    own = lock.stat()
    for fd in [int(one.name) for one in Path("/proc/self/fd").iterdir()]:
        with suppress(OSError):  # the descriptor by which the directory was read is closed
            is_lock = os.path.samestat(os.fstat(fd), own)
            if fd > 2 and fd != kept and not is_lock:
                os.close(fd)

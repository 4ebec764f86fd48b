"""A child process that does what this one leaves undone when it is killed, as by SIGKILL.

The out-of-memory killer, too, takes one process without a word. Only the kernel tells of it, by the
end of a connection. The child has the lock of its parent, see flock(2), so nobody else takes it
until it has done its work. It has a session of its own, and ignores what it can ignore, so only
SIGKILL to the whole cgroup ends both: then nobody does the work, and the next command has to.
"""

import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Those that ask a process to end, and with it all others of its group or unit."""
_MORE = (signal.SIGQUIT, signal.SIGABRT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM)
"""Those that a unit or a terminal can have for that, too, see KillSignal= in systemd.kill(5). They
end this process, as the caller wants; the child goes on."""

_WORD = b"."


@contextmanager
def guarded(end: Callable[[], None], lock: Path) -> Iterator[None]:
    """Call `end` in another process if this one is killed in the block.

    lock: the lock file that it goes on to hold; it holds nothing else that is open here.
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
        for stream in range(3):  # whoever reads our output to its end does not wait for this
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
        with suppress(OSError):  # that of the list is gone
            is_lock = os.path.samestat(os.fstat(fd), own)
            if fd > 2 and fd != kept and not is_lock:
                os.close(fd)

"""Bytes to and from a child process that another user can stop, trace and make lie.

It may take nothing and say nothing, or answer what it was never asked: so neither direction waits
longer than the caller wants.
"""

import os
import select
import time

_CHUNK = 65536


def send(fd: int, data: bytes, deadline: float) -> None:
    """Write all of it to the pipe `fd`, until `deadline` (seconds of the monotonic clock).

    Raises BrokenPipeError if nobody takes it in time.
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

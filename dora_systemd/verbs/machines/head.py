"""What `doractl member` hears from the head, and says to it, until its relay takes over."""

import os
import select
import time
from contextlib import suppress
from threading import Event, Lock, Thread

from dora_systemd.decisions.machines.wire import (
    BEAT_SECONDS,
    MAX_LINE,
    Beat,
    Message,
    Part,
    expect,
    format_message,
    parse_message,
)
from dora_systemd.errors import DoraSystemdError


class Head:
    """The head, by two file descriptors. Within its block it hears that this side is there.

    line_seconds: for each line until the part: the head may just start, and have much else to do.
    """

    line_seconds = 30.0
    most_seconds = 60.0

    def __init__(self, reading: int = 0, writing: int = 1) -> None:
        self._reading, self._writing = reading, writing
        self._lock = Lock()
        self._over = Event()
        self._beats = Thread(target=self._beat, daemon=True)

    def __enter__(self) -> "Head":
        self._beats.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._beats.join()

    def part(self) -> Part:
        """What to run. Raises DoraSystemdError (FAILURE) if nobody says it."""
        most = time.monotonic() + self.most_seconds
        while True:
            deadline = min(most, time.monotonic() + self.line_seconds)
            line = read_line(self._reading, deadline)
            if not line.endswith(b"\n") and len(line) < MAX_LINE:
                raise _silent()
            message = parse_message(line)
            if not isinstance(message, Beat):
                return expect(message, Part)

    def tell(self, message: Message) -> None:
        """Say something, if the head is still there."""
        self.say(format_message(message))

    def say(self, line: bytes) -> None:
        """Say a whole line."""
        with self._lock, suppress(OSError):
            os.write(self._writing, line)

    def _beat(self) -> None:
        while not self._over.is_set():
            self.tell(Beat())
            self._over.wait(BEAT_SECONDS)


def read_line(fd: int, deadline: float, most: int = MAX_LINE) -> bytes:
    """One line, and not a byte more: what follows is for the relay.

    Without its end if nobody says more, or not before `deadline`, in seconds of the monotonic
    clock, or after `most` bytes. Raises OSError.
    """
    line = b""
    while not line.endswith(b"\n") and len(line) < most:
        seconds = max(deadline - time.monotonic(), 0)
        byte = os.read(fd, 1) if select.select([fd], [], [], seconds)[0] else b""
        if not byte:
            break
        line += byte
    return line


def _silent() -> DoraSystemdError:
    hint = "doractl start on the head starts the members"
    return DoraSystemdError("cannot run a member: no head says what to run", hint)

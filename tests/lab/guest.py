"""The lab's end of the agent's port: run a command over there, as if it were here."""

import contextlib
import fcntl
import json
import os
import signal
import socket
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence

from lab.errors import LabError
from lab.wire import PIECE, pack_frame, pack_size, read_frame

Sink = Callable[[bytes], None]


class Guest:
    def __init__(self, port: socket.socket) -> None:
        self.port = port

    def wait_boot(self, seconds: float) -> None:
        self.port.settimeout(seconds)
        try:
            while read_frame(self.port.recv)[0] != b"H":
                pass
        except (TimeoutError, EOFError):
            raise LabError("boot the machine") from None
        self.port.settimeout(None)

    def request(self, command: Sequence[str], terminal: bool = False, resume: bool = False) -> None:
        body: dict[str, object] = {"command": list(command), "terminal": terminal}
        if resume:
            body |= {"now": time.time(), "seed": os.urandom(64).hex()}
        self.send(b"R", json.dumps(body).encode())

    def send(self, kind: bytes, body: bytes = b"") -> None:
        with contextlib.suppress(ConnectionError):  # told by the reader, better
            self.port.sendall(pack_frame(kind, body))

    def send_pieces(self, descriptor: int) -> None:
        while piece := os.read(descriptor, PIECE):
            self.send(b"I", piece)

    def send_input(self, descriptor: int) -> None:
        self.send_pieces(descriptor)
        self.send(b"I")

    def wait_exit(self, out: Sink, err: Sink) -> int:
        status = self.follow(out, err)
        if status is None:
            raise LabError("go on: the machine has restarted")
        return status

    def follow(self, out: Sink, err: Sink) -> int | None:
        """The exit status of the command, None if the machine has restarted before its end."""
        sinks = {b"O": out, b"E": err}
        try:
            while (frame := read_frame(self.port.recv))[0] not in (b"X", b"H"):
                sinks[frame[0]](frame[1])
        except (EOFError, ConnectionError):
            raise LabError("go on: the machine has ended") from None
        return int(frame[1]) if frame[0] == b"X" else None

    def run_through_cuts(self, command: Sequence[str], seconds: float) -> int:
        """Run a command that restarts the machine, and again after each boot, until it exits.

        seconds: in which something must come from the machine, or it is not up again.
        """
        self.port.settimeout(seconds)
        while True:
            self.request(command)
            self.send(b"I")
            try:
                status = self.follow(write_out, write_err)
            except TimeoutError:
                raise LabError("boot the machine") from None
            if status is not None:
                return status

    def run_quietly(self, command: Sequence[str]) -> int:
        self.request(command)
        self.send(b"I")
        return self.wait_exit(lambda _: None, write_err)

    def run(self, command: Sequence[str], terminal: bool) -> int:
        self.request(command, terminal)
        if terminal:
            self.follow_terminal()
        # It may wait for input forever: nobody waits for it, the lab just ends.
        threading.Thread(target=self.send_input, args=(0,), daemon=True).start()
        return self.wait_exit(write_out, write_err)

    def follow_terminal(self) -> None:
        tty.setraw(sys.stdin)
        signal.signal(signal.SIGWINCH, lambda *_: self.send_size())
        self.send_size()

    def send_size(self) -> None:
        size = fcntl.ioctl(0, termios.TIOCGWINSZ, pack_size(0, 0))
        self.send(b"W", size)


def write_out(data: bytes) -> None:
    write_all(1, data)


def write_err(data: bytes) -> None:
    write_all(2, data)


def write_all(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]

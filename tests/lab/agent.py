"""Runs inside the machine, waits in its snapshot: runs what the lab asks for, one by one."""

import fcntl
import json
import os
import pty
import struct
import subprocess
import termios
import threading
import time
import tty
from pathlib import Path
from typing import Any, BinaryIO

from lab.wire import PIECE, pack_frame, read_frame

RNDADDENTROPY = 0x40085203
RNDRESEEDCRNG = 0x5207


class Agent:
    def __init__(self, port: int) -> None:
        self.port = port
        self.is_line = os.isatty(port)
        self.sending = threading.Lock()
        self.stdin = -1
        self.terminal = False

    def serve(self) -> None:
        self.send(b"H")
        while True:
            try:
                kind, body = read_frame(self.read)
            except EOFError:  # nobody at the other end of the port
                time.sleep(0.02)
            else:
                HANDLERS[kind](self, body)

    def read(self, count: int) -> bytes:
        data = os.read(self.port, count)
        if self.is_line:
            self.send(b"A", str(len(data)).encode())
        return data

    def send(self, kind: bytes, body: bytes = b"") -> None:
        frame = memoryview(pack_frame(kind, body))
        with self.sending:
            while frame:
                frame = frame[os.write(self.port, frame) :]

    def start(self, body: bytes) -> None:
        request: dict[str, Any] = json.loads(body)
        if "now" in request:
            catch_up(request["now"], bytes.fromhex(request["seed"]))
        self.terminal = request["terminal"]
        if self.terminal:
            self.start_on_terminal(request)
        else:
            self.start_on_pipes(request)

    def start_on_pipes(self, request: dict[str, Any]) -> None:
        pipe = subprocess.PIPE
        process = subprocess.Popen(request["command"], stdin=pipe, stdout=pipe, stderr=pipe)
        assert process.stdin and process.stdout and process.stderr
        self.stdin = os.dup(process.stdin.fileno())
        process.stdin.close()
        pumps = [self.pump(process.stdout, b"O"), self.pump(process.stderr, b"E")]
        threading.Thread(target=self.finish, args=(process, pumps), daemon=True).start()

    def start_on_terminal(self, request: dict[str, Any]) -> None:
        self.stdin, slave = pty.openpty()
        command = ["setsid", "--ctty", "--wait", *request["command"]]
        process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave)
        os.close(slave)
        pumps = [self.pump(os.fdopen(os.dup(self.stdin), "rb", buffering=0), b"O")]
        threading.Thread(target=self.finish, args=(process, pumps), daemon=True).start()

    def pump(self, source: Any, kind: bytes) -> threading.Thread:
        thread = threading.Thread(target=self.forward, args=(source, kind), daemon=True)
        thread.start()
        return thread

    def forward(self, source: BinaryIO, kind: bytes) -> None:
        with source:
            while piece := read_some(source.fileno()):
                self.send(kind, piece)

    def finish(self, process: subprocess.Popen[bytes], pumps: list[threading.Thread]) -> None:
        status = process.wait()
        for thread in pumps:
            thread.join()
        self.close_stdin()
        self.send(b"X", str(status).encode())

    def give_input(self, body: bytes) -> None:
        if not body:
            self.close_stdin()
        rest = memoryview(body)
        try:
            while rest and self.stdin >= 0:
                rest = rest[os.write(self.stdin, rest) :]
        except OSError:  # the command does not want it
            self.close_stdin()

    def close_stdin(self) -> None:
        descriptor, self.stdin = self.stdin, -1
        if descriptor >= 0:
            os.close(descriptor)

    def resize(self, body: bytes) -> None:
        if self.terminal and self.stdin >= 0:
            fcntl.ioctl(self.stdin, termios.TIOCSWINSZ, body)


HANDLERS = {b"R": Agent.start, b"I": Agent.give_input, b"W": Agent.resize}


def read_some(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, PIECE)
    except OSError:  # EIO: how a terminal says that its last user has closed it
        return b""


def catch_up(now: float, seed: bytes) -> None:
    """Every resume starts with the same clock and the same random numbers to come."""
    time.clock_settime(time.CLOCK_REALTIME, now)
    with Path("/dev/urandom").open("wb") as urandom:
        packed = struct.pack(f"ii{len(seed)}s", len(seed) * 8, len(seed), seed)
        fcntl.ioctl(urandom, RNDADDENTROPY, packed)
        fcntl.ioctl(urandom, RNDRESEEDCRNG)


def open_port() -> int:
    """That of an emulator has a name; that of a kernel in user mode is its first serial line."""
    for name in Path("/sys/class/virtio-ports").glob("*/name"):
        if name.read_text().strip() == "lab":
            return os.open(f"/dev/{name.parent.name}", os.O_RDWR | os.O_CLOEXEC)
    line = os.open("/dev/ttyS0", os.O_RDWR | os.O_CLOEXEC | os.O_NOCTTY)
    tty.setraw(line)
    return line


if __name__ == "__main__":
    Agent(open_port()).serve()

"""A node of the dataflow that the faults are applied to: prints numbered lines, and obeys orders.

It is copied into the project. argv: its role. NOTES: the directory of its notes and orders.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
from dora import Node

ROLE = sys.argv[1]
NOTES = Path(os.environ["NOTES"])
LIFE = f"{ROLE}.{time.time_ns()}"
FLOOD = 20_000


class Lines:
    """Numbered lines on stdout; a file says how many there are, so that others know as well."""

    def __init__(self) -> None:
        self.count = 0
        self._note = os.open(NOTES / LIFE, os.O_WRONLY | os.O_CREAT, 0o644)

    def write(self, count: int = 1) -> None:
        """Write the next `count` lines; what is noted may be one write behind, never ahead."""
        first = self.count + 1
        self.count += count
        text = "".join(f"{LIFE} {number:08d}\n" for number in range(first, first + count))
        os.write(1, text.encode())
        os.pwrite(self._note, b"%08d" % self.count, 0)


def obey(lines: Lines) -> None:
    """Carry out the order for this role, if there is one; it is gone before that."""
    for order in NOTES.glob(f"order.{ROLE}.*"):
        order.unlink()
        ORDERS[order.suffix[1:]](lines)


def leave_child(lines: Lines) -> None:
    """Fail, and leave a child with our stdout behind."""
    del lines
    if os.fork() == 0:
        time.sleep(1000)
    os._exit(1)


def daemonise(lines: Lines) -> None:
    """Become nobody's child, in a session of our own; what dora knows of fails."""
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            os.closerange(0, 3)
            time.sleep(1000)
        os._exit(0)
    leave_child(lines)


def ignore_everything(lines: Lines) -> None:
    """Hear no more of dora, and of no signal that can be ignored."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    lines.write()
    while True:
        time.sleep(100)


def spin(lines: Lines) -> None:
    """Compute for ever."""
    lines.write()
    while True:
        pass


def fork_bomb(lines: Lines) -> None:
    """Fork until the kernel does not want it any more, and fail."""
    lines.write()
    try:
        while True:
            if os.fork() == 0:
                time.sleep(1000)
    except BlockingIOError:
        os._exit(1)


def flood(lines: Lines) -> None:
    """Fill stdout."""
    for _ in range(FLOOD // 50):
        lines.write(50)


ORDERS: dict[str, Callable[[Lines], object]] = {
    "exit0": lambda _: os._exit(0),
    "exit1": lambda _: os._exit(1),
    "abort": lambda _: os.abort(),
    "leave-child": leave_child,
    "daemonise": daemonise,
    "ignore": ignore_everything,
    "spin": spin,
    "flood": flood,
    "fork-bomb": fork_bomb,
}


def main() -> None:
    """Pass numbers on, one line for each."""
    node, lines = Node(), Lines()
    for event in node:
        if event["type"] == "INPUT":
            lines.write()
            obey(lines)
            if ROLE != "sink":
                node.send_output("number", pa.array([lines.count]))


if __name__ == "__main__":
    main()

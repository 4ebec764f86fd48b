"""What a node says to its notify socket: the assignments of sd_notify(3) that mean something here.

A node says it about itself only, so READY=1, MAINPID=, FDSTORE=1 and the like have no effect: dora
knows when a node is ready, and which process it is.
"""

from typing import NamedTuple

MAX_BYTES = 4096
"""Maximum bytes of a message, as in systemd; a longer one is dropped."""
MAX_STATUS = 200
"""Characters kept of STATUS=."""


class Message(NamedTuple):
    """One message. status: the text of STATUS=, None without one; "" takes the last one back."""

    is_alive: bool = False
    is_trigger: bool = False
    status: str | None = None


def parse_message(data: bytes) -> Message:
    """The message in a datagram. Whatever it contains, nothing is raised."""
    alive = trigger = False
    status = None
    for line in data.split(b"\n"):
        key, _, value = line.partition(b"=")
        if key == b"WATCHDOG":
            alive |= value == b"1"
            trigger |= value == b"trigger"
        elif key == b"STATUS":
            status = _clean(value)
    return Message(alive, trigger, status)


def _clean(value: bytes) -> str:
    """One line that cannot control a terminal: str.isprintable() knows such characters."""
    text = value.decode("utf-8", "replace")
    words = "".join(one if one.isprintable() else " " for one in text).split()
    return " ".join(words)[:MAX_STATUS]

"""Messages of a node to its notify socket, see sd_notify(3), and what the status table keeps.

A node only reports about itself, so READY=1, MAINPID=, FDSTORE=1 and the like have no effect: dora
knows when a node is ready, and which process it is.
"""

from typing import Any, NamedTuple

from dora_systemd.values import INFINITY

MAX_BYTES = 4096
"""Maximum bytes of a message, as in systemd; a longer one is dropped."""
_DIGITS = 20
"""Of a number with 64 bits."""
MAX_STATUS = 200
"""Characters kept of STATUS=."""


class Message(NamedTuple):
    """One message."""

    is_alive: bool = False
    is_trigger: bool = False
    extend: int = 0  # µs of EXTEND_TIMEOUT_USEC=, 0 without one
    status: str | None = None  # the text of STATUS=, None without one; "" clears the last text


def parse_message(data: bytes) -> Message:
    """The message in a datagram. Whatever it contains, nothing is raised."""
    alive = trigger = False
    status, extend = None, 0
    for line in data.split(b"\n"):
        key, _, value = line.partition(b"=")
        if key == b"WATCHDOG":
            alive |= value == b"1"
            trigger |= value == b"trigger"
        elif key == b"EXTEND_TIMEOUT_USEC":
            extend = _micros(value)
        elif key == b"STATUS":
            status = _clean(value)
    return Message(alive, trigger, extend, status)


def _micros(value: bytes) -> int:
    """The number of µs, 0 for anything else."""
    is_number = value.isdigit() and len(value) <= _DIGITS
    return min(int(value), INFINITY) if is_number else 0


def _clean(value: bytes) -> str:
    """Clean a text to one line that cannot control a terminal, by str.isprintable()."""
    text = value.decode("utf-8", "replace")
    words = "".join(one if one.isprintable() else " " for one in text).split()
    return " ".join(words)[:MAX_STATUS]


class Sign(NamedTuple):
    """The last messages of one node about itself."""

    status: str = ""  # the text of STATUS=, or ""
    at_us: int = 0  # CLOCK_MONOTONIC µs of its last WATCHDOG=1, 0: none
    watchdog: int = 0  # µs, 0 without one


def parse_sign(raw: Any) -> Sign:
    """Parse a Sign in a table that the nodes' user can write; an invalid one becomes empty."""
    match raw:
        case [str() as status, int() as at_us, int() as watchdog] if _are_times(at_us, watchdog):
            return Sign(status[:MAX_STATUS], at_us, watchdog)
    return Sign()


def _are_times(*numbers: int) -> bool:
    return all(type(one) is int and 0 <= one < INFINITY // 2 for one in numbers)


def sign_facts(sign: Sign, now_us: int) -> dict[str, Any]:
    """The fields of a NodeRow. now_us: CLOCK_MONOTONIC."""
    return {
        "text": sign.status,
        "watchdog": sign.watchdog or None,
        "sign_age": max(now_us - sign.at_us, 0) if sign.at_us else None,
    }

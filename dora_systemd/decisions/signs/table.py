"""The signs of life in the table that a runner writes, as `list` and the metrics show them."""

from typing import Any, NamedTuple

from dora_systemd.decisions.signs.messages import MAX_STATUS
from dora_systemd.values import INFINITY


class Sign(NamedTuple):
    """What one node has said of itself.

    status: the text of STATUS=, or "". at_us: CLOCK_MONOTONIC µs of its last WATCHDOG=1, 0: none.
    watchdog: µs, 0 without one.
    """

    status: str = ""
    at_us: int = 0
    watchdog: int = 0


def parse_sign(raw: Any) -> Sign:
    """A sign in a table that the nodes' user can write; what is none becomes an empty one."""
    match raw:
        case [str() as status, int() as at_us, int() as watchdog] if _is_time(at_us, watchdog):
            return Sign(status[:MAX_STATUS], at_us, watchdog)
    return Sign()


def _is_time(*numbers: int) -> bool:
    return all(type(one) is int and 0 <= one < INFINITY // 2 for one in numbers)


def sign_facts(sign: Sign, now_us: int) -> dict[str, Any]:
    """The fields of a NodeRow. now_us: CLOCK_MONOTONIC."""
    return {
        "text": sign.status,
        "watchdog": sign.watchdog or None,
        "sign_age": max(now_us - sign.at_us, 0) if sign.at_us else None,
    }

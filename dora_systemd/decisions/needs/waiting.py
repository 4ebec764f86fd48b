"""How people are told who waits for what, and since when. Pure, and quick to import."""

from dora_systemd.values import format_moment

WAITS = " waits for "
"""Between who waits and what for: in STATUS=, between a node and what it needs."""
START = "the start"
"""Who waits while systemd holds the start of a dataflow."""


def format_wait(who: str, needs: str, since_us: int) -> str:
    """As "camera waits for /dev/video0 since 2026-11-22 14:02:11 UTC"; 0 is unknown."""
    clock = f"{format_moment(since_us)[:19].replace('T', ' ')} UTC"
    return f"{who}{WAITS}{needs}" + (f" since {clock}" if since_us else "")

"""Human-readable text of a wait: who waits for what, since when. Pure, and quick to import."""

from dora_systemd.values import format_moment

WAITS = " waits for "
"""The text in STATUS= between a node and what the node needs."""
START = "the start"
"""Who waits while systemd holds the start of a dataflow."""


def format_wait(who: str, needs: str, since_us: int) -> str:
    """Format "camera waits for /dev/video0 since 2026-11-22 14:02:11 UTC". since_us: 0: unknown."""
    clock = f"{format_moment(since_us)[:19].replace('T', ' ')} UTC"
    return f"{who}{WAITS}{needs}" + (f" since {clock}" if since_us else "")

"""What is said of a node that its watchdog has ended.

Journals keep these texts, so they never change.
"""

from dora_systemd.decisions.signs.judge import Phase
from dora_systemd.values import format_duration

TRIGGERED = "it sent WATCHDOG=trigger"
_SAYS = {Phase.RUNNING: "no WATCHDOG=1 for ", Phase.STARTING: "not ready within "}


def missed(phase: Phase, limit: int) -> str:
    """The reason for a watchdog of `limit` µs."""
    return f"{_SAYS[phase]}{format_duration(limit)}"


def by_watchdog(reason: str) -> bool:
    """Whether a node hung for one of these reasons, and not by dora's health check."""
    return reason == TRIGGERED or reason.startswith(tuple(_SAYS.values()))

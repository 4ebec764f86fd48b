"""What nodes of a running dataflow waited for: CPU time, and who had it. Pure."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.resources.rivals import Rival, Shared
from dora_systemd.values import SECOND

WORTH_SHOWING = 20.0
"""Percent of the time; `top` shows shorter waits, too."""
MINUTE = 60 * SECOND
_MOST = 3
"""Nodes that are shown."""


class CpuWait(NamedTuple):
    """How long a node waited for a CPU."""

    node: str  # "" for the whole dataflow
    waited: float | None = None  # percent of `span`
    span: int = MINUTE  # µs until now
    throttled: float | None = None  # percent of the time, None without a CPU limit
    cpus: str = ""  # those of the node, "" if its settings name none
    rivals: tuple[Rival, ...] = ()
    shared: tuple[Shared, ...] = ()

    @property
    def is_throttled(self) -> bool:
        """Whether its CPU limit is why."""
        return (self.throttled or 0.0) >= WORTH_SHOWING

    @property
    def is_late(self) -> bool:
        """Whether it waited long enough to be shown."""
        return self.is_throttled or (self.waited or 0.0) >= WORTH_SHOWING

    def __str__(self) -> str:
        whose = self.node or "the dataflow"
        parts = []
        if (self.waited or 0.0) >= WORTH_SHOWING:
            parts.append(f"{whose} waited {self.waited:.0f}% of {_span(self.span)} for a CPU")
            whose = "it"
        if self.is_throttled:
            parts.append(f"{whose} had to wait for its limit {self.throttled:.0f}% of the time")
        busy = [*map(str, self.rivals), *map(str, self.shared)]
        where = f"cpus {self.cpus}" if self.cpus else "the CPUs"
        also = f": {where} also have {', '.join(busy)}" if busy else ""
        return f"{', '.join(parts)}{also}"

    def values(self) -> dict[str, Any]:
        return {
            "node": self.node or None,
            "waited_percent": None if self.waited is None else round(self.waited, 1),
            "span_us": self.span,
            "throttled_percent": None if self.throttled is None else round(self.throttled, 1),
            "cpus": self.cpus or None,
            "processes": [one.values() for one in self.rivals],
            "interrupts": [one.values() for one in self.shared],
        }


def _span(span: int) -> str:
    return "the last minute" if span == MINUTE else f"{span / SECOND:.1f} s"


def format_cpu_waits(waits: Sequence[CpuWait]) -> str:
    """The nodes that waited most; "" if none waited long."""
    more = len(waits) - _MOST
    texts = [*map(str, waits[:_MOST]), *([f"{more} more waited"] if more > 0 else [])]
    return "; ".join(texts)


def wait_remedies(waits: Sequence[CpuWait], name: str) -> list[str]:
    """What to do about these waits, a line each."""
    found = (text for one in waits[:_MOST] for text in _remedies(one, name))
    return list(dict.fromkeys(found))


def _remedies(one: CpuWait, name: str) -> Iterator[str]:
    if one.is_throttled and one.node:
        yield f"raise its CPU limit: doractl set {name} --node {one.node}:cpu_limit=CORES"
    elif one.is_throttled:
        yield f"raise its CPU limit: doractl set {name} --cpu-limit SHARE"
    for shared in one.shared:
        yield f"move {shared} away from cpus {shared.cpus}: {shared.remedy}"
    if not one.rivals or not one.node:
        return
    if one.cpus:
        yield (
            f"keep other processes away from cpus {one.cpus}: AllowedCPUs= in their units, see "
            "systemd.resource-control(5)"
        )
    else:
        yield f"give {one.node} CPUs of its own: cpus: below nodes: in its settings"

"""Finds whose memory limit was exceeded when the kernel has killed a node.

The counters are those of memory.events and memory.events.local in the kernel's "Control Group v2"
document.
"""

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

from dora_systemd.values import format_rounded_size


class Owner(Enum):
    """Whose memory was used up: the node's, the dataflow's or the machine's."""

    NODE = "node"
    DATAFLOW = "dataflow"
    MACHINE = "machine"


class OomCounts(NamedTuple):
    """Counters of one group, which only increase."""

    kills: int = 0  # OOM kills in the group and below it
    refusals: int = 0  # how often the limit of this group itself was the reason


class Oom(NamedTuple):
    """The OOM kill of a node. Sizes in bytes."""

    owner: Owner
    peak: int  # the node's maximum
    limit: int = 0  # of the owner, 0 for the machine
    most: str = ""  # the node with the highest usage, and its size
    most_held: int = 0

    @property
    def text(self) -> str:
        """The end of the node, for the live table."""
        peak, limit = format_rounded_size(self.peak), format_rounded_size(self.limit)
        if self.owner is Owner.NODE:
            return f"out of memory, peak {peak}, limit {limit}"
        if self.owner is Owner.DATAFLOW:
            return f"out of memory, peak {peak}, limit of the dataflow {limit}"
        return f"out of memory, peak {peak}, the machine had no memory left"

    def node_details(self) -> dict[str, str]:
        """Details of the event node-oom."""
        return {"exit": self.text, "peak": str(self.peak), **self.owner_details()}

    def owner_details(self) -> dict[str, str]:
        """Whose memory was used up, in both that event and dataflow-failed."""
        return owner_details(self.owner, self.limit)

    def dataflow_details(self) -> dict[str, str]:
        """Details of the event dataflow-oom."""
        held, limit = format_rounded_size(self.most_held), format_rounded_size(self.limit)
        return {
            "reason": f"of {limit} the node {self.most} held most, {held}",
            "limit": str(self.limit),
            "most": self.most,
            "held": str(self.most_held),
        }


def owner_details(owner: Owner, limit: int = 0) -> dict[str, str]:
    """Details of an event: whose memory was used up, and the limit of that in bytes; 0 is none."""
    return {"owner": owner.value, **({"limit": str(limit)} if limit else {})}


def find_owner(
    node: tuple[OomCounts, OomCounts], unit: tuple[OomCounts, OomCounts]
) -> Owner | None:
    """Whose memory was used up between two readings of node and unit; None: no OOM kill."""
    if node[1].kills <= node[0].kills:
        return None
    if node[1].refusals > node[0].refusals:
        return Owner.NODE
    return Owner.DATAFLOW if unit[1].refusals > unit[0].refusals else Owner.MACHINE


def largest(held: Mapping[str, int]) -> tuple[str, int]:
    """The node with the highest usage, and its size; "" if there is none."""
    return max(held.items(), key=lambda item: item[1], default=("", 0))

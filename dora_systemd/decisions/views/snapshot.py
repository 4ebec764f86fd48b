"""A snapshot of one dataflow with the counters of its groups.

Two snapshots give percentages of time: for `doractl top`, the page in a browser, and Prometheus.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.resources.usage import LineCount, Strain, Usage
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.rows import DataflowRow


@dataclass(frozen=True)
class Observed:
    """A dataflow."""

    row: DataflowRow  # its row in `list`
    at_us: int = 0  # time of its counters, CLOCK_MONOTONIC
    unit_restarts: int = 0  # number of automatic restarts by systemd
    # usage, strains, lines: by node, WHOLE_CELL is the whole dataflow; empty if it is not up
    usage: Mapping[str, Usage] = field(default_factory=dict)
    strains: Mapping[str, Strain] = field(default_factory=dict)
    lines: Mapping[str, LineCount] = field(default_factory=dict)


def observed_values(one: Observed) -> dict[str, Any]:
    """The snapshot for JSON; time counters in µs."""
    away = {node.node for node in one.row.nodes if node.machine}
    groups = {
        key: {
            **_counters(use, one.strains.get(key, Strain())),
            # Not for shares of time: a member sends it now and then.
            **({"cpu_us": None} if key in away else {}),
        }
        for key, use in one.usage.items()
    }
    return {**dataflow_object(one.row), "monotonic_us": one.at_us, "groups": groups}


def _counters(use: Usage, strain: Strain) -> dict[str, Any]:
    periods, throttled = use.throttling
    return {
        "cpu_us": use.cpu_us,
        "periods": periods,
        "throttled_periods": throttled,
        "stalled_us": {resource: some for resource, (some, _) in strain.stalled.items()},
        "oom_kills": strain.oom_kills,
    }

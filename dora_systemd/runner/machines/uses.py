"""What the nodes of a member use, read for its head: that cannot see the cgroups here."""

import time
from collections.abc import Mapping
from typing import Any

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.counters import CpuSample
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.machines.usage import told_use
from dora_systemd.runner.nodes.nodes import Nodes


class Uses:
    """Reads the groups of the nodes as often as the runner samples them, and at each new stage."""

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self._seen: tuple[object, str] = ((), "")
        self._told: Mapping[str, list[Any]] = {}

    def added(self, table: CellStatus) -> CellStatus:
        """The table of this machine, with what its nodes use."""
        seen = table.samples, table.stage
        if seen != self._seen:
            self._seen, self._told = seen, self._read(table)
        return table._replace(usage=self._told)

    def _read(self, table: CellStatus) -> Mapping[str, list[Any]]:
        groups = cgroup.node_groups(self._nodes.places[0])
        uses = {node: cgroup.read_usage(groups[node]) for node in table.nodes if node in groups}
        now = CpuSample(
            time.monotonic_ns() // 1000,
            {node: use.cpu_us for node, use in uses.items()},
            {node: use.throttling for node, use in uses.items()},
        )
        return {node: told_use(use, table.samples, now, node) for node, use in uses.items()}

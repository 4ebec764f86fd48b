"""Ends the nodes of this machine without dora, which would wait for a machine that is gone."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Iterable
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.runner.nodes.nodes import Nodes

_LOOK_SECONDS = 0.05


async def end_nodes(nodes: Nodes, own: Iterable[str], seconds: float) -> None:
    """SIGTERM for every process of the nodes `own`; SIGKILL for what is left after `seconds`."""
    unit, _ = nodes.places
    own = list(own)
    nodes.let_go()
    # Dora takes each end for a crash. A launcher that it starts now leaves at its gate.
    nodes.gates.make(own)
    nodes.gates.dismiss()
    groups = cgroup.node_groups(unit)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await asyncio.gather(*(_end(groups[node]) for node in own if node in groups))
    nodes.kill()


async def _end(group: Path) -> None:
    """Return when no process of the group is left. One that comes meanwhile gets the signal too."""
    told: set[int] = set()
    while pids := {*cgroup.pids(group)}:
        for pid in pids - told:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGTERM)
        told |= pids
        await asyncio.sleep(_LOOK_SECONDS)

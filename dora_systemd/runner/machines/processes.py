"""Finds the first processes of the nodes of a member.

Dora has told of them before this machine could hear it: a member looks for the run that the head
has started. Their launchers wait for the pipes, and have noted their pid.
"""

import asyncio
import contextlib

from dora_systemd.decisions.life import events as life
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.nodes.nodes import Nodes

_MOST_SECONDS = 10.0
_POLL_SECONDS = 0.05


async def find(pump: Pump, nodes: Nodes) -> None:
    """Tell the pids of nodes that are starting, until each of them is known or has gone on."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_MOST_SECONDS):
            while missing := _without_process(pump):
                for node in missing:
                    _tell(pump, nodes, node, nodes.noted_pid(node))
                await asyncio.sleep(_POLL_SECONDS)


def _without_process(pump: Pump) -> list[str]:
    found = pump.cell.nodes.items()
    return [ident for ident, one in found if one.state == "starting" and not one.pid]


def _tell(pump: Pump, nodes: Nodes, node: str, pid: int) -> None:
    if pid:
        nodes.adopt(node, pid)
        pump.push(life.NodeSpawned(now_us(), node, pid))

"""What head and members have in common: some nodes of their dataflow run elsewhere."""

import asyncio
import contextlib
import hashlib
import os
import signal
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.machines.part import (
    MOST_FILES,
    differing,
    is_here,
    own_dataflow,
    own_options,
    parse_digests,
)
from dora_systemd.decisions.machines.wire import Part
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.begin import Daemon
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.machine_role import Alone
from dora_systemd.runner.machines.boot import member_arguments
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.reload.sources import Sources
from dora_systemd.trust.eyes import read_regular
from dora_systemd.values import INFINITY


class Shared(Alone):
    """The role of one of several machines; head and member override it further."""

    @property
    def start_timeout(self) -> int:
        """Never: the time begins when all members have joined, and the head measures it."""
        return INFINITY

    def own(self, options: RunnerOptions) -> RunnerOptions:
        return own_options(options)

    def here(self, dataflow: Dataflow) -> Dataflow:
        return own_dataflow(self.options, dataflow)


ASK_SECONDS = 5.0
"""Timeout of a request: a coordinator that waits for a machine does not answer for 30 s."""
NOISE = (
    b"Gossip is disabled: cannot de-duplicate",
    b"Scouting delay elapsed before start conditions are met",
    b"peer daemon disconnected",
    b"WS coordinator connection error",
)
"""Warnings that zenoh-machines.json5 causes, and those about machines, which we report better."""


class SharedEngine(Engine):
    """The dora of a head or a member."""

    machine = ""  # the name of its daemon, "" on the head

    async def heartbeats(self) -> list[tuple[str, int]]:
        """Return the machine of each connected daemon, and µs since its last heartbeat.

        Raises DoraSystemdError.
        """
        reply = await self.ask_soon(protocol.CONNECTED_DAEMONS)
        return protocol.parse_heartbeats(reply)

    async def ask_soon(self, params: protocol.Params) -> protocol.Reply:
        """Send a request. Raises DoraSystemdError, also if ASK_SECONDS are not enough."""
        try:
            async with asyncio.timeout(ASK_SECONDS):
                return await self.ask(params)
        except TimeoutError as error:
            raise DoraSystemdError("the dora coordinator does not answer") from error

    async def is_joined(self) -> bool:
        """Whether the daemon of this machine has registered."""
        return any(machine == self.machine for machine, _ in await self.heartbeats())


class MemberEngine(SharedEngine):
    """The daemon of a member; its coordinator is on the head."""

    def set_part(self, part: Part, addresses: Sequence[str]) -> None:
        """Set how to reach the head. That is in memory only. addresses: of the options."""
        self.machine, self._port, self._token = part.machine, part.coordinator, part.token
        self._more = member_arguments(part, self._environment, addresses)

    def cut_off(self) -> None:
        """Kill the daemon, because its coordinator is gone.

        The daemon would connect to the same port of 127.0.0.1 again, send the token, and start
        whatever that side requests. The link is gone as well, so any user can listen on the port.
        """
        if daemon := self._children.get("daemon"):
            daemon.send_signal(signal.SIGKILL)

    def _write_access(self, daemon: Daemon) -> None:
        """Write nothing: only the head sends requests to the coordinator."""

    async def find_silent(self, seconds: float) -> str:
        """Return "": only the head finds out whether the daemon hangs."""
        del seconds
        return ""


_MOST_BYTES = 32 << 20
"""Maximum bytes of a file that is compared."""


def own_digests(
    options: RunnerOptions, prepared: Prepared, environment: Mapping[str, str]
) -> dict[str, str]:
    """Compute the digests of the programs of this machine's nodes. Raises DoraSystemdError."""
    by_node = Sources(options, environment).files(prepared)
    files = {one for node, some in by_node.items() if is_here(options, node) for one in some}
    root = Path(options.dataflow).parent
    return read_digests(root, sorted(os.path.relpath(one, root) for one in files))


def read_digests(root: Path, paths: Iterable[str]) -> dict[str, str]:
    """Compute the digests of the regular files among `paths`, which are relative to `root`."""
    found = {path: _digest(root / path) for path in list(paths)[:MOST_FILES] if path[:2] != ".."}
    return {path: one for path, one in found.items() if one}


async def find_others(root: Path, told: str) -> list[str]:
    """Find the files below `root` that a member, whose Programs has `told`, has otherwise."""
    try:
        there = parse_digests(told)
    except (ValueError, RecursionError):
        return []
    return differing(await asyncio.to_thread(read_digests, root, there), there)


def _digest(path: Path) -> str:
    try:
        data = read_regular(path, _MOST_BYTES + 1)
    except (OSError, ValueError):
        return ""
    return hashlib.sha256(data).hexdigest() if len(data) <= _MOST_BYTES else ""


_LOOK_SECONDS = 0.05


class Patience(NamedTuple):
    """Seconds of a node that ends without dora."""

    until_sigterm: float
    until_sigkill: float  # after SIGTERM


async def end_nodes(
    nodes: Nodes, own: Iterable[str], seconds: float, apart: Mapping[str, Patience] | None = None
) -> None:
    """End the nodes `own` without dora, which would wait for a machine that is gone.

    Every process gets SIGTERM, and SIGKILL if it is left after `seconds`. apart: the time of nodes
    that have another one.
    """
    usual, apart = Patience(0.0, seconds), apart or {}
    unit, _ = nodes.places
    own = list(own)
    nodes.let_go()
    # Dora takes each end for a crash. A launcher that it starts now leaves at its gate.
    nodes.gates.make(own)
    nodes.gates.dismiss()
    groups = cgroup.node_groups(unit)
    ends = (_end_within(groups[one], apart.get(one, usual)) for one in own if one in groups)
    await asyncio.gather(*ends)
    nodes.kill()


async def _end_within(group: Path, patience: Patience) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(patience.until_sigterm):
            while [*cgroup.pids(group)]:
                await asyncio.sleep(_LOOK_SECONDS)
    try:
        async with asyncio.timeout(patience.until_sigkill):
            await _end(group)
    except TimeoutError:
        cgroup.kill_group(group)


async def _end(group: Path) -> None:
    """Send SIGTERM to the processes of a group, also to new ones, until none is left."""
    told: set[int] = set()
    while pids := {*cgroup.pids(group)}:
        for pid in pids - told:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGTERM)
        told |= pids
        await asyncio.sleep(_LOOK_SECONDS)

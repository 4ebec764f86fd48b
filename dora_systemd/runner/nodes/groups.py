"""The cgroups of nodes: counters of memory and CPU, and freezing while the journal is behind.

Also notices containers that nodes start outside of their cgroups, for the journal.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.strain import read_load, read_oom
from dora_systemd.adapters.host.process_table import PROC, beginning
from dora_systemd.decisions.cell.extra import EXTRA
from dora_systemd.decisions.cell.log_backlog import Marks
from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.resources.oom import Oom, OomCounts, Owner, find_owner, largest
from dora_systemd.decisions.resources.pressure import Alarms, Load, Most, is_quiet, look
from dora_systemd.decisions.resources.usage import (
    WHOLE_CELL,
    CpuSample,
    cpu_percent,
    limit_of,
    throttled_percent,
)
from dora_systemd.values import SECOND

PROGRAMS = (b"podman", b"docker", b"nerdctl")


class ClientWatch:
    """Checks each process of a node once: most processes are no clients."""

    def __init__(self, proc: Path = PROC) -> None:
        self._proc = proc
        self._seen: frozenset[int] = frozenset()

    def look(self, groups: Mapping[str, Path]) -> list[Record]:
        """Return an event for each client that has begun. groups: of the nodes."""
        pids = {node: frozenset(cgroup.pids(path)) for node, path in groups.items()}
        new = {node: sorted(some - self._seen) for node, some in pids.items()}
        self._seen = frozenset().union(*pids.values())
        return [one for node, some in new.items() for one in self._records(node, some)]

    def _records(self, node: str, pids: list[int]) -> Iterator[Record]:
        if not (clients := [pid for pid in pids if self._is_client(pid)]):
            return
        # Imported late: few nodes start containers.
        from dora_systemd.adapters.host.clients import read_clients

        for one in read_clients(clients, self._proc):
            # Without root, podman executes itself again in a user namespace.
            if not (one.is_split or one.parent in clients):
                yield Record(
                    "container-outside", node, {"program": one.program, "container": one.name}
                )

    def _is_client(self, pid: int) -> bool:
        with suppress(OSError):
            return beginning(self._proc / str(pid) / "comm").strip() in PROGRAMS
        return False


_ONE_SHORTAGE = 5.0
"""Seconds in which the kernel kills further processes for the same reason."""


class Resources:
    """Counters of the unit's cgroups, kept from one sample to the next."""

    def __init__(self, unit: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._unit = unit
        self._clock = clock
        self._short_until = 0.0
        self._seen: dict[Path, OomCounts] = {unit: read_oom(unit)}
        self._alarms: Alarms = {}
        self._most: dict[str, Most] = {}
        self._clients = ClientWatch()
        self.is_quiet = False
        """Whether the groups hardly used CPU time before the last look(), and have no limit."""

    def explain(self, group: Path) -> Oom | None:
        """Find whether a process in a group has just been killed because of memory, and how."""
        node = self._seen.get(group, OomCounts()), read_oom(group)
        if node[1] == node[0]:
            return None
        unit = self._seen[self._unit], read_oom(self._unit)
        self._seen |= {group: node[1], self._unit: unit[1]}
        owner = self._same(find_owner(node, unit))
        return None if owner is None else self._oom(owner, group)

    def _same(self, owner: Owner | None) -> Owner | None:
        """Return the owner of the limit, for further kills of one shortage that of the first."""
        if owner is Owner.DATAFLOW:
            self._short_until = self._clock() + _ONE_SHORTAGE
        is_same = owner is Owner.MACHINE and self._clock() < self._short_until
        return Owner.DATAFLOW if is_same else owner

    def _oom(self, owner: Owner, group: Path) -> Oom:
        peak = cgroup.read_usage(group).memory_peak or 0
        if owner is Owner.MACHINE:
            return Oom(owner, peak)
        limited = group if owner is Owner.NODE else self._unit
        limit = cgroup.read_usage(limited).memory_max or 0
        groups = cgroup.node_groups(self._unit)
        held = {node: cgroup.read_usage(path).memory or 0 for node, path in groups.items()}
        # The victim's memory has been freed by now: use its peak.
        held |= {node: peak for node, path in groups.items() if path == group}
        return Oom(owner, peak, limit, *largest(held))

    def look(self, samples: tuple[CpuSample, ...], now: CpuSample) -> list[Record]:
        """Return events about limits that are close, and about containers without limits.

        samples: those before `now`.
        """
        found = cgroup.node_groups(self._unit)
        nodes = {node: path for node, path in found.items() if node not in EXTRA}
        groups = {WHOLE_CELL: self._unit, **nodes}
        loads = {key: _load(path, key, samples, now) for key, path in groups.items()}
        self._most |= {key: self._most.get(key, Most()).after(one) for key, one in loads.items()}
        self._alarms, reports = look(self._alarms, loads, now.at_us)
        self.is_quiet = bool(samples) and is_quiet(loads)
        return [*(Record(*one) for one in reports), *self._clients.look(nodes)]

    def most(self, key: str) -> dict[str, str]:
        """Return the details of an end: the most that a node, or WHOLE_CELL, has used so far."""
        return self._most.get(key, Most()).details()


def _load(path: Path, key: str, samples: tuple[CpuSample, ...], now: CpuSample) -> Load:
    # Without an earlier sample the time that was used is not known.
    used = cpu_percent(samples, now, key) if samples else 0.0
    load = read_load(path)._replace(cpu=used)
    # A group without a CPU limit is never throttled.
    if not any(now.throttling.get(key, ())):
        return load
    share = limit_of(cgroup.read_usage(path).cpu_max)
    limit = None if share is None else 100 * share / SECOND
    return load._replace(throttled=throttled_percent(samples, now, key), cpu_limit=limit)


class Hold:
    """Freezes the cgroup of one node while too many bytes of its output are unread.

    Only for nodes whose output dora's daemon reads: a node with pipes blocks in write(2) instead.
    The kernel freezes a group by cgroup.freeze, see cgroups(7).
    """

    def __init__(self, group: Path, marks: Marks) -> None:
        self._group = group
        self._marks = marks
        self._is_held = False
        self._since = 0.0
        self._is_paused = False
        self._is_over = False

    def look(self, backlog: int) -> None:
        """Freeze or thaw the group for this many unread bytes.

        If the kernel does not allow freezing, the node keeps running and lost lines are counted.
        """
        now = time.monotonic()
        is_held = self._marks.is_held(self._is_held, now - self._since, backlog)
        is_held = is_held and not (self._is_paused or self._is_over)
        if is_held != self._is_held:
            self._is_held = cgroup.freeze_group(self._group, is_held) and is_held
            self._since = now

    @property
    def is_held(self) -> bool:
        """Whether the group is frozen now."""
        return self._is_held

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Keep the node thawed in the context: it must receive dora's message of its end."""
        self._is_paused = True
        self.look(0)
        try:
            yield
        finally:
            self._is_paused = False

    def end(self) -> None:
        """Thaw the node and never freeze it again, so that it receives dora's request to stop."""
        self._is_over = True
        self.look(0)

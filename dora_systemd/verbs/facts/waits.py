"""How long the nodes of a running dataflow waited for a CPU, and who had it."""

import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.strain import read_waited
from dora_systemd.adapters.host.process_table import PROC, process_group
from dora_systemd.adapters.host.rivals import (
    TICKS,
    Interrupts,
    read_delay,
    read_thread_cpus,
    read_times,
)
from dora_systemd.decisions.cell.limits import CPUS, limits_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.needs.words import NET, needs_of
from dora_systemd.decisions.resources.rivals import (
    Interrupt,
    Rival,
    Shared,
    busiest,
    on_cpus,
    share_interrupts,
)
from dora_systemd.decisions.resources.usage import WHOLE_CELL
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.waits import MINUTE, WORTH_SHOWING, CpuWait
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.paths import reached
from dora_systemd.values import INFINITY, SECOND, cpu_numbers, parse_cpus
from dora_systemd.verbs.facts.list import row_of
from dora_systemd.verbs.facts.reading import Reading

_SAMPLE_SECONDS = 0.3
_MOST_BUSY = 10
"""Processes whose threads are read."""
_NODE = r"dora-([^/]+)\.service/node-([^/]+)"

Delays = Mapping[str, int]
Sleep = Callable[[float], None]


def read_cpu_waits(
    reading: Reading, proc: Path = PROC, sleep: Sleep = time.sleep
) -> tuple[CpuWait, ...]:
    """Read the nodes that waited for a CPU, the longest wait first.

    Where the kernel has no pressure stall information, this measures for a moment. proc: has the
    files of all processes.
    """
    groups = {key: path for key, path in reading.groups.items() if key != WHOLE_CELL}
    waited = {node: read_waited(path) for node, path in groups.items()}
    row = row_of(reading)
    found = list(_throttled(row))
    if any(one is None or one >= WORTH_SHOWING for one in waited.values()):
        sample = _Sample(groups, waited, proc, sleep)
        cpus = {one.node: one.cpus for one in row.nodes}
        throttled = {one.node: one.throttled for one in row.nodes}
        late = (sample.wait(node, cpus.get(node, ""), reading.cell.options) for node in groups)
        waits = [one._replace(throttled=throttled.get(one.node)) for one in late]
        found = [one for one in found if one.node not in groups] + waits
    late_ones = [one for one in found if one.is_late]
    return tuple(sorted(late_ones, key=lambda one: -max(one.waited or 0, one.throttled or 0)))


def _throttled(row: DataflowRow) -> Iterator[CpuWait]:
    """Yield the dataflow and its nodes with their CPU limits."""
    yield CpuWait("", throttled=row.throttled)
    for one in row.nodes:
        yield CpuWait(one.node, throttled=one.throttled, cpus=one.cpus)


class _Sample:
    """What the processes of this machine used in a moment.

    waited: what the kernel has measured by node, None where it does not.
    """

    def __init__(
        self,
        groups: Mapping[str, Path],
        waited: Mapping[str, float | None],
        proc: Path,
        sleep: Sleep,
    ) -> None:
        self._waited, self._proc = waited, proc
        group = f"/{next(iter(groups.values())).relative_to(cgroup.mount_point())}"
        self._place = _unit_place(group).above
        self._pids = {node: frozenset(cgroup.some_pids(path)) for node, path in groups.items()}
        delays, before, began = self._delays(), read_times(proc), time.monotonic()
        sleep(_SAMPLE_SECONDS)
        self._span = max(time.monotonic() - began, 1 / TICKS)
        self._delayed = {key: one - delays[key] for key, one in self._delays().items()}
        now, ticks = read_times(proc), self._span * TICKS
        self._busy = busiest(before, now, ticks, [os.getpid()])[:_MOST_BUSY]  # not the reader
        self._threads = {one.pid: read_thread_cpus(one.pid, proc) for one in self._busy}
        self._interrupts = Interrupts()

    def _delays(self) -> Delays:
        unknown = [node for node, one in self._waited.items() if one is None]
        return {node: read_delay(self._pids[node], self._proc) for node in unknown}

    def wait(self, node: str, cpus: str, options: RunnerOptions) -> CpuWait:
        """Return the wait of a node with who had its CPUs, unless that is too short to matter."""
        waited, span = self._waited[node], MINUTE
        if waited is None:
            span = int(self._span * SECOND)
            waited = min(self._delayed[node] / 10 / span, 100.0)  # ns of µs, in percent
        if waited < WORTH_SHOWING:
            return CpuWait(node, waited, span, cpus=cpus)
        bits = parse_cpus(cpus) if cpus else 0
        others = [one for one in self._busy if one.pid not in self._pids[node]]
        rivals = on_cpus(others, self._threads, cpu_numbers(bits))
        shared = _shared(self._interrupts, options, node, bits)
        named = tuple(_with_node(one, self._place, self._proc) for one in rivals)
        return CpuWait(node, waited, span, cpus=cpus, rivals=named, shared=shared)


def _with_node(rival: Rival, above: Sequence[str], proc: Path) -> Rival:
    """The rival with the node that it belongs to. above: the manager of its dataflow."""
    place = _unit_place(process_group(rival.pid, proc))
    match = re.match(_NODE, f"{place.unit}/{place.below}") if place.above == above else None
    return rival._replace(node=f"{match[2]} of {match[1]}") if match else rival


class _UnitPlace(NamedTuple):
    """The unit of a process, by its cgroup. Users choose the names of the groups below it."""

    above: Sequence[str]  # the unit of the user's manager that it belongs to
    unit: str
    below: str


def _unit_place(group: str) -> _UnitPlace:
    """Find the unit in the path of a cgroup, see systemd.slice(5)."""
    above = list[str]()
    parts = group.split("/")
    for number, part in enumerate(parts, 1):
        if part.endswith((".service", ".scope")):
            if not part.startswith("user@"):
                return _UnitPlace(above, part, "/".join(parts[number:]))
            above.append(part)
    return _UnitPlace(above, "", "")


def shared_interrupts(interrupts: Interrupts, options: RunnerOptions) -> Iterator[Shared]:
    """Yield the interrupts of devices that nodes need, on the CPUs that their settings name."""
    for limits in limits_of(options):
        bits = dict(limits.limits).get(CPUS, INFINITY)
        if bits != INFINITY:
            yield from _shared(interrupts, options, limits.node, bits)


def _shared(
    interrupts: Interrupts, options: RunnerOptions, node: str, cpus: int
) -> tuple[Shared, ...]:
    if not cpus:
        return ()
    online = interrupts.online
    return tuple(
        shared
        for need in needs_of(options)
        if need.node == node
        for shared in share_interrupts(node, need.what, cpus, online, _of(interrupts, need.what))
    )


def _of(interrupts: Interrupts, need: str) -> list[tuple[Interrupt, int]]:
    """The interrupts of a device file or an interface; none for another path."""
    if need.startswith(NET):
        return interrupts.of_interface(need.removeprefix(NET))
    with suppress(OSError, DoraSystemdError), reached(need) as (fd, _):
        status = os.fstat(fd)
        is_block = stat.S_ISBLK(status.st_mode)
        if is_block or stat.S_ISCHR(status.st_mode):
            return interrupts.of_number(status.st_rdev, is_block)
    return []

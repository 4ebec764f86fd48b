"""Checks that limits can be enforced: required controllers, and the size of the machine."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

from dora_systemd.decisions.cell.limits import BY_KEY, CPUS, LIMITS, NodeLimits
from dora_systemd.decisions.properties.assignments import Properties
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.values import (
    INFINITY,
    SECOND,
    cpu_bits,
    cpu_numbers,
    format_cpus,
    format_rounded_size,
)

_CONTROLLERS = {
    **{limit.property: limit.controller() for limit in LIMITS},
    **dict.fromkeys(("StartupCPUWeight",), "cpu"),
    **dict.fromkeys(("MemoryMin", "MemoryLow", "MemoryZSwapMax"), "memory"),
    **dict.fromkeys(("StartupIOWeight", "IODeviceWeight", "IODeviceLatencyTargetSec"), "io"),
    **dict.fromkeys(("IOReadBandwidthMax", "IOWriteBandwidthMax"), "io"),
    **dict.fromkeys(("IOReadIOPSMax", "IOWriteIOPSMax"), "io"),
}
"""Keys of a unit that need a controller, see systemd.resource-control(5)."""

_MEMORY = "memory_limit"
_USES = {
    _MEMORY: ("memory", "uses", "the kernel may kill processes then"),
    "tasks_limit": ("tasks", "has", "no process and no thread can start then"),
}
"""What is limited by key, how its use is reported, and what follows from a limit below that."""
Used = Mapping[str, int | None]
"""The memory in bytes and the number of tasks that are in use, by the key of their limit."""
_MEGABYTE = 1024 * 1024
_STOP_POST_BYTES = 12 * _MEGABYTE
"""What ExecStopPost= of a dataflow takes."""


class Machine(NamedTuple):
    """The machine's size: memory in bytes, number of processors, maximum tasks, and online CPUs."""

    memory: int
    cores: int
    tasks: int
    cpus: frozenset[int] | None = None  # None if they are not known


def needed_controllers(properties: Properties, nodes: Iterable[NodeLimits]) -> dict[str, str]:
    """The controllers that limits need, each with one of these limits in words."""
    needed = {
        _CONTROLLERS[slot]: f"{slot}="
        for slot, one in properties.items()
        if slot in _CONTROLLERS and one.value != INFINITY
    }
    for one in nodes:
        for key, value in one.limits:
            if value != INFINITY:
                needed.setdefault(BY_KEY[key].controller(), f"{key} of the node {one.node}")
    return needed


def check_cpus(nodes: Iterable[NodeLimits], machine: Machine) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for CPUs that the machine lacks."""
    for one in nodes:
        wanted = set(cpu_numbers(dict(one.limits).get(CPUS, 0)))
        if machine.cpus is not None and (missing := wanted - machine.cpus):
            raise bad_input(
                f"cannot bind the node {one.node} to the cpus {_cpu_list(missing)}: "
                "this machine has none with that number",
                f"its cpus are {_cpu_list(machine.cpus)}",
            )


def _cpu_list(cpus: Iterable[int]) -> str:
    return format_cpus(cpu_bits(cpus))


def check_controllers(needed: Mapping[str, str], available: Collection[str], is_user: bool) -> None:
    """Raise DoraSystemdError (NO_SYSTEMD) unless all required controllers exist.

    available: the controllers of the unit's manager.
    """
    for controller, what in needed.items():
        if controller not in available:
            more = "cpuset " if controller == "cpuset" else ""
            delegated = f"Delegate=cpu {more}memory pids io"
            hint = f"as root: systemctl edit user@.service, [Service] {delegated}"
            raise DoraSystemdError(
                f"cannot enforce {what}: systemd has no {controller!r} cgroup controller",
                hint if is_user else "the kernel or the container does not provide it",
                ExitCode.NO_SYSTEMD,
            )


def size_warnings(
    limits: Mapping[str, int | None], nodes: Iterable[NodeLimits], machine: Machine
) -> tuple[str, ...]:
    """A warning for each limit above the machine's size. limits: of the dataflow, by key."""
    own = {key: value for key, value in limits.items() if value is not None}
    there = {
        "memory_limit": machine.memory,
        "memory_high": machine.memory,
        "cpu_limit": machine.cores * SECOND,
        "tasks_limit": machine.tasks,
    }
    whole = {key: own[key] for key in there if key in own and key != "memory_high"}
    found = [*_above("the dataflow", own, there, "this machine has")]
    for one in nodes:
        whose, of_node = f"the node {one.node}", dict(one.limits)
        found += _above(whose, of_node, there, "this machine has")
        found += _above(whose, of_node, whole, "the dataflow may use")
    return tuple(found)


def check_use(
    limits: Mapping[str, int | None],
    nodes: Iterable[NodeLimits],
    whole: Used,
    held: Mapping[str, Used],
) -> None:
    """Raise DoraSystemdError for the first limit of memory or tasks below the current usage.

    limits: of the dataflow, by key. whole, held: what it uses, and what each node uses.
    """
    every = [("the dataflow", limits, whole)]
    every += [(f"the node {n.node}", dict(n.limits), held.get(n.node, {})) for n in nodes]
    for whose, own, used in every:
        for key, (what, does, hint) in _USES.items():
            limit, now = own.get(key), used.get(key)
            if limit is not None and now is not None and limit < now:
                raise DoraSystemdError(
                    f"cannot limit the {what} of {whose} to {_shown(key, limit)}: "
                    f"it {does} {_shown(key, now)} now",
                    f"--force does it; {hint}",
                )


def check_kept(limit: int | None, kept: int) -> None:
    """Raise DoraSystemdError for a memory limit of the dataflow that systemd would hang in.

    kept: bytes of files in memory, such as those in /dev/shm, which stay when all processes have
    ended. systemd starts ExecStopPost= in the same group. Where that group is above its limit and
    has nothing that the kernel may kill, systemd waits for that start until the machine is reset
    (systemd issue 40208).
    """
    least = -(-(kept + _STOP_POST_BYTES) // _MEGABYTE) * _MEGABYTE
    if limit is not None and kept and limit < least:
        raise DoraSystemdError(
            f"cannot limit the memory of the dataflow to {_shown(_MEMORY, limit)}: "
            f"{_shown(_MEMORY, kept)} are files in memory, which stay when its processes end",
            f"{_shown(_MEMORY, least)} or more; systemd would hang in less",
        )


def _above(
    whose: str, limits: Mapping[str, int], bounds: Mapping[str, int], there: str
) -> Iterator[str]:
    for key, most in bounds.items():
        value = limits.get(key, 0)
        if most < value < INFINITY:
            limit, bound = _shown(key, value), _shown(key, most)
            if limit == bound:  # rounded; only sizes are
                limit, bound = (f"{one // _MEGABYTE}M" for one in (value, most))
            yield f"the limit {key}={limit} of {whose} is more than {there}: {bound}"


def _shown(key: str, value: int) -> str:
    if key == "cpu_limit":
        return f"{value / SECOND:g} core{'' if value == SECOND else 's'}"
    return str(value) if key == "tasks_limit" else format_rounded_size(value)

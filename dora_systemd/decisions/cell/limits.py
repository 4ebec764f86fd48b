"""Resource limits: what can be limited for a node, how it is written, and its control file.

The control files are those of the kernel's "Control Group v2" document.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import check_known
from dora_systemd.values import (
    INFINITY,
    SECOND,
    cpus_file,
    format_cpu,
    format_cpus,
    format_number,
    format_size,
    parse_cpu,
    parse_cpus,
    parse_size,
    quoted,
)

if TYPE_CHECKING:  # `list` loads this module, and needs no options
    from dora_systemd.decisions.cell.options import RunnerOptions

SMALLEST_MEMORY = 1024 * 1024
"""Bytes. A smaller value is a missing suffix: no program runs in so little memory."""

SMALLEST_CPU = SECOND // 100
"""µs of CPU per second."""

HIGHEST_WEIGHT = 10_000

_PERIOD = 100_000
"""µs: the kernel's default period of cpu.max."""

_NUMBER = r"[0-9]{1,18}"

CPUS = "cpus"
"""The limit that is no amount: which CPUs, see dora_systemd.values."""


def parse_memory(text: str) -> int:
    """Bytes of memory, at least 1M; INFINITY for no limit. Raises DoraSystemdError (USAGE)."""
    if (size := parse_size(text)) < SMALLEST_MEMORY:
        raise _too_small(text, "memory", "1M, such as 512M or 4G")
    return size


def parse_share(text: str) -> int:
    """µs of CPU per second, at least a hundredth of a core. Raises DoraSystemdError (USAGE)."""
    if (share := parse_cpu(text)) < SMALLEST_CPU:
        raise _too_small(text, "CPU time", "0.01 cores, such as 1.5")
    return share


def _too_small(text: str, what: str, smallest: str) -> DoraSystemdError:
    hint = f"write at least {smallest}; or infinity for no limit"
    return usage_error(f"cannot use {quoted(text)} as a limit of {what}", hint)


def parse_tasks(text: str) -> int:
    """A number of processes and threads, or INFINITY. Raises DoraSystemdError (USAGE)."""
    if text.strip() == "infinity":
        return INFINITY
    return _parse_number(text, 1, 2**32 - 1, "a number of tasks", "write at least 1; or infinity")


def parse_weight(text: str) -> int:
    """A weight relative to others, from 1 to 10000. Raises DoraSystemdError (USAGE)."""
    hint = f"write a number from 1 to {HIGHEST_WEIGHT}; other units have 100"
    return _parse_number(text, 1, HIGHEST_WEIGHT, "a weight", hint)


def _parse_number(text: str, lowest: int, highest: int, what: str, hint: str) -> int:
    if not re.fullmatch(_NUMBER, text.strip()) or not lowest <= int(text) <= highest:
        raise usage_error(f"cannot use {quoted(text)} as {what}", hint)
    return int(text)


def _plain_file(value: int) -> str:
    return "max" if value == INFINITY else str(value)


def _quota_file(share: int) -> str:
    """cpu.max: quota and period in µs."""
    return f"{'max' if share == INFINITY else share * _PERIOD // SECOND} {_PERIOD}"


class Limit(NamedTuple):
    """A resource that can be limited, for a dataflow and for a node."""

    key: str  # the setting
    property: str  # of the unit, see systemd.resource-control(5)
    file: str  # the control file of cgroup v2
    parse: Callable[[str], int]  # text to value
    format: Callable[[int], str] = format_number  # value to text
    file_text: Callable[[int], str] = _plain_file  # the text for the control file

    def controller(self) -> str:
        """The controller of cgroup v2 that enforces it."""
        return self.file.partition(".")[0]


LIMITS = (
    Limit("cpu_limit", "CPUQuota", "cpu.max", parse_share, format_cpu, _quota_file),
    Limit("memory_limit", "MemoryMax", "memory.max", parse_memory, format_size),
    Limit("memory_high", "MemoryHigh", "memory.high", parse_memory, format_size),
    # A limit of 0 is useful for swap, unlike for memory.
    Limit("swap_limit", "MemorySwapMax", "memory.swap.max", parse_size, format_size),
    Limit("tasks_limit", "TasksMax", "pids.max", parse_tasks),
    Limit("cpu_weight", "CPUWeight", "cpu.weight", parse_weight),
    Limit("io_weight", "IOWeight", "io.weight", parse_weight, file_text="default {}".format),
    Limit(CPUS, "AllowedCPUs", "cpuset.cpus", parse_cpus, format_cpus, cpus_file),
)
BY_KEY: Mapping[str, Limit] = {limit.key: limit for limit in LIMITS}


class NodeLimits(NamedTuple):
    """The limits of one node: pairs of a key of LIMITS and its value, in their order."""

    node: str
    limits: tuple[tuple[str, int], ...]

    def files(self) -> dict[str, str]:
        """The text for each control file of the node's group."""
        return {BY_KEY[key].file: BY_KEY[key].file_text(value) for key, value in self.limits}


def node_limits(node: str, limits: Mapping[str, int]) -> NodeLimits:
    """The limits of `node`, by key."""
    return NodeLimits(node, tuple((key, limits[key]) for key in BY_KEY if key in limits))


def has_cpus(limits: NodeLimits) -> bool:
    """Whether the node is bound to some CPUs."""
    return dict(limits.limits).get(CPUS, INFINITY) != INFINITY


def without_cpus(limits: NodeLimits) -> NodeLimits:
    """The limits that need no cpuset controller."""
    kept = tuple(pair for pair in limits.limits if pair[0] != CPUS)
    return limits._replace(limits=kept)


@lru_cache(maxsize=4)
def limits_of(options: "RunnerOptions") -> tuple[NodeLimits, ...]:
    """The limits of single nodes. Raises DoraSystemdError."""
    named = dict.fromkeys(one.node for one in options.settings if one.node and one.key in BY_KEY)
    found = {key: options.by_node(key) for key in BY_KEY} if named else {}
    return tuple(
        node_limits(node, {key: own[node] for key, own in found.items() if node in own})
        for node in named
    )


def check_nodes(limits: Iterable[NodeLimits], nodes: Iterable[str], dynamic: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for limits of an unknown or dynamic node.

    nodes: all ids. dynamic: nodes that dora does not start; their processes are in other cgroups.
    """
    known, free = list(nodes), frozenset(dynamic)
    for one in limits:
        check_known("cannot limit", [one.node], known)
        if one.node in free:
            hint = "limit what it is started with"
            reason = "it is dynamic, so it does not run inside the dataflow's unit"
            raise bad_input(f"cannot limit the node {quoted(one.node)}: {reason}", hint)

"""The settings that limit a dataflow or its nodes, see systemd.resource-control(5)."""

import re
from typing import Any

from dora_systemd.decisions.cell.limits import (
    BY_KEY,
    LIMITS,
    NodeLimits,
    format_node_limits,
    merge_node_limits,
    parse_node_limits,
)
from dora_systemd.decisions.settings.kinds import Base, Kind, Setting, scalar_text, texts_of
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted

_DEVICE = re.compile(r"(/dev/\S+?|(?:char|block)-\S+?)(?:[: ]([rwm]+))?")
_REALTIME = re.compile(r"(?:(rr|fifo):)?([0-9]{1,2})")
_LOWEST_NICE, _HIGHEST_NICE = -20, 19
_DEFAULT_ACCESS = "rw"

_EXPECTED = {
    "memory": "a size such as 512M or 4G",
    "cpu": "cores such as 1.5, or a share of one such as 150%",
    "pids": "a number of tasks",
}
_METAVARS = {"memory": "SIZE", "cpu": "CORES", "pids": "N"}
_HELPS = {
    "cpu_limit": "CPU time that all nodes together may use, in cores.",
    "memory_limit": "Memory that all nodes together may use; beyond it a node is killed.",
    "memory_high": "Memory beyond which the nodes are slowed down.",
    "swap_limit": "Swap space that all nodes together may use.",
    "tasks_limit": "Processes and threads that the dataflow may have.",
    "cpu_weight": "Share of CPU time under contention, 1 to 10000; other units have 100.",
    "io_weight": "Share of disk time under contention, 1 to 10000; other units have 100.",
}


def _limit_setting(key: str) -> Setting[int | None]:
    limit = BY_KEY[key]
    is_weight = key.endswith("weight")
    kind = Kind[int](
        str | int | float,
        "a weight from 1 to 10000" if is_weight else _EXPECTED[limit.controller],
        lambda value, _: limit.parse(scalar_text(value)),
        lambda value: [limit.format(value)],
    )
    return Setting(
        key,
        kind,
        None,
        _HELPS[key],
        flags=(f"--{key.replace('_', '-')}",),
        variable=f"DORA_{key.upper()}",
        metavar="WEIGHT" if is_weight else _METAVARS[limit.controller],
        per_node=True,
        property=limit.property,
        # A higher weight takes resources from all others on the machine.
        root_only=is_weight,
    )


def _texts(value: Any) -> list[str]:
    return [scalar_text(one) for one in texts_of(value)]


def _parse_nice(value: Any, base: Base) -> int:
    del base
    text = scalar_text(value).strip()
    if not re.fullmatch(r"[-+]?[0-9]{1,2}", text) or not _LOWEST_NICE <= int(text) <= _HIGHEST_NICE:
        hint = f"write a number from {_LOWEST_NICE}, most important, to {_HIGHEST_NICE}"
        raise DoraSystemdError(f"cannot use {quoted(text)} as nice value", hint, ExitCode.USAGE)
    return int(text)


def _parse_realtime(value: Any, base: Base) -> str:
    """POLICY:PRIORITY, or PRIORITY, see sched(7)."""
    del base
    text = scalar_text(value).strip()
    match = _REALTIME.fullmatch(text)
    if not match or int(match[2]) == 0:
        hint = "write a priority from 1 to 99, with rr: or fifo: in front of it or without"
        message = f"cannot use {quoted(text)} as realtime priority"
        raise DoraSystemdError(message, hint, ExitCode.USAGE)
    return f"{match[1] or 'rr'}:{int(match[2])}"


def _parse_devices(value: Any, base: Base) -> tuple[str, ...]:
    """Devices as for DeviceAllow=: a path or a group, and the permissions."""
    del base
    return tuple(_parse_device(text) for text in _texts(value))


def _parse_device(text: str) -> str:
    match = _DEVICE.fullmatch(text.strip())
    if not match or not text.isprintable():
        hint = "write a path below /dev, or char-GROUP; :r behind it lets it be read only"
        raise DoraSystemdError(f"cannot allow the device {quoted(text)}", hint, ExitCode.USAGE)
    return f"{match[1]} {match[2] or _DEFAULT_ACCESS}"


def _parse_node_limits(value: Any, base: Base) -> tuple[NodeLimits, ...]:
    del base
    return merge_node_limits(*([parse_node_limits(text)] for text in _texts(value)))


CPU_LIMIT = _limit_setting("cpu_limit")
MEMORY_LIMIT = _limit_setting("memory_limit")
MEMORY_HIGH = _limit_setting("memory_high")
SWAP_LIMIT = _limit_setting("swap_limit")
TASKS_LIMIT = _limit_setting("tasks_limit")
CPU_WEIGHT = _limit_setting("cpu_weight")
IO_WEIGHT = _limit_setting("io_weight")
NODE_LIMIT = Setting[tuple[NodeLimits, ...]](
    "node_limit",
    Kind[tuple[NodeLimits, ...]](
        str | list[str],
        "NODE:memory=1G,cpu=1.5 or a list of such texts",
        _parse_node_limits,
        lambda value: [format_node_limits(one) for one in value],
        is_repeatable=True,
        merge=lambda lower, higher: merge_node_limits(lower, higher),
    ),
    (),
    f"Limits of one node: {', '.join(limit.word for limit in LIMITS)}.",
    flags=("--node-limit",),
    metavar="NODE:LIMIT=VALUE,...",
)
NICE = Setting[int | None](
    "nice",
    Kind[int](int | str, "a number from -20 to 19", _parse_nice, lambda value: [str(value)]),
    None,
    "Nice value of all processes, see nice(1).",
    flags=("--nice",),
    variable="DORA_NICE",
    metavar="N",
    property="Nice",
    root_only=True,
)
REALTIME = Setting[str | None](
    "realtime",
    Kind[str](
        int | str, "a priority such as 20 or fifo:20", _parse_realtime, lambda value: [value]
    ),
    None,
    "Realtime scheduling of all processes with this priority, 1 to 99; see sched(7).",
    flags=("--realtime",),
    variable="DORA_REALTIME",
    metavar="[rr:|fifo:]PRIORITY",
    root_only=True,
)
DEVICE = Setting[tuple[str, ...]](
    "device",
    Kind[tuple[str, ...]](
        str | list[str],
        "a path below /dev or a list of them",
        _parse_devices,
        list,
        is_repeatable=True,
        merge=lambda lower, higher: lower + higher,
    ),
    (),
    "Device that the nodes may use; all other devices are then blocked.",
    flags=("--device",),
    metavar="PATH[:r|w|rw]",
    property="DeviceAllow",
)
LIVE_SETTINGS: tuple[Setting[Any], ...] = (
    *(CPU_LIMIT, MEMORY_LIMIT, MEMORY_HIGH, SWAP_LIMIT, TASKS_LIMIT, CPU_WEIGHT, IO_WEIGHT),
    NODE_LIMIT,
)
"""Settings that can be changed while the dataflow is running."""

LIMIT_SETTINGS: tuple[Setting[Any], ...] = (*LIVE_SETTINGS, NICE, REALTIME, DEVICE)

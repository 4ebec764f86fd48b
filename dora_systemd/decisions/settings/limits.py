"""The settings that limit a dataflow or its nodes, see systemd.resource-control(5)."""

import re
from collections.abc import Sequence
from operator import add
from typing import Any

from dora_systemd.decisions.cell.limits import BY_KEY, check_nodes, limits_of
from dora_systemd.decisions.cell.line_rates import RateLimit, format_rate, parse_rate
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import is_negative, parse_nice
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.decisions.settings.kinds import Setting, many_texts, one_text
from dora_systemd.decisions.settings.rights import check_rights
from dora_systemd.errors import usage_error
from dora_systemd.values import quoted

_DEVICE = r"(/dev/\S+?|(?:char|block)-\S+?)(?:[: ]([rwm]+))?"
_REALTIME = r"(?:(rr|fifo):)?([0-9]{1,2})"
_DEFAULT_ACCESS = "rw"

_EXPECTED = {
    "memory": ("a size such as 512M or 4G", "SIZE"),
    "cpu": ("cores such as 1.5, or a share of one such as 150%", "CORES"),
    "pids": ("a number of tasks", "N"),
    "weight": ("a weight from 1 to 10000", "WEIGHT"),
}
_HELPS = {
    "cpu_limit": "CPU time that all nodes together may use, in cores.",
    "memory_limit": "Memory that all nodes together may use; beyond it a node is killed.",
    "memory_high": "Memory beyond which the nodes are slowed down.",
    "swap_limit": "Swap space that all nodes together may use.",
    "tasks_limit": "Processes and threads that the dataflow may have.",
    "cpu_weight": "Share of CPU time under contention, 1 to 10000; other units have 100.",
    "io_weight": "Share of disk time under contention, 1 to 10000; other units have 100.",
}


def _limit_setting(key: str, help_text: str) -> Setting[int | None]:
    limit = BY_KEY[key]
    is_weight = key.endswith("weight")
    words = _EXPECTED["weight" if is_weight else limit.controller()]
    return Setting(
        key,
        one_text(str | int | float, *words, limit.parse, limit.format),
        None,
        help_text,
        per_node=True,
        property=limit.property,
        # A higher weight takes resources from all others on the machine.
        root_only=is_weight,
        check=_check,
    )


def _parse_realtime(given: str) -> str:
    """POLICY:PRIORITY, or PRIORITY, see sched(7)."""
    text = given.strip()
    match = re.fullmatch(_REALTIME, text)
    if not match or int(match[2]) == 0:
        hint = "write a priority from 1 to 99, with rr: or fifo: in front of it or without"
        raise usage_error(f"cannot use {quoted(text)} as realtime priority", hint)
    return f"{match[1] or 'rr'}:{int(match[2])}"


def _parse_device(text: str) -> str:
    """A device as for DeviceAllow=: a path or a group, and the permissions."""
    match = re.fullmatch(_DEVICE, text.strip())
    if not match or not text.isprintable():
        hint = "write a path below /dev, or char-GROUP; :r behind it lets it be read only"
        raise usage_error(f"cannot allow the device {quoted(text)}", hint)
    return f"{match[1]} {match[2] or _DEFAULT_ACCESS}"


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    dynamic = [node.id for node in nodes if node.kind is NodeKind.DYNAMIC]
    check_nodes(limits_of(options), [node.id for node in nodes], dynamic)


NICE = Setting[int | None](
    "nice",
    one_text(int | str, "a number from -20 to 19", "N", parse_nice),
    None,
    "Nice value of all processes, see nice(1).",
    per_node=True,
    property="Nice",
    root_only=True,
    raises=is_negative,
    check=check_rights,
)
REALTIME = Setting[str | None](
    "realtime",
    one_text(int | str, "a priority such as 20 or fifo:20", "[rr:|fifo:]PRIORITY", _parse_realtime),
    None,
    "Realtime scheduling of all processes with this priority, 1 to 99; see sched(7).",
    root_only=True,
)
DEVICE = Setting[tuple[str, ...]](
    "device",
    many_texts(
        "a path below /dev or a list of them",
        "PATH[:r|w|rw]",
        lambda texts: tuple(map(_parse_device, texts)),
        list,
        add,
    ),
    (),
    "Device that the nodes may use; all other devices are then blocked.",
    property="DeviceAllow",
)
CPUS = Setting[int | None](
    "cpus",
    one_text(
        int | str, "CPUs such as 2-3 or 0,2", "LIST", BY_KEY["cpus"].parse, BY_KEY["cpus"].format
    ),
    None,
    "CPUs that the node may use, such as 2-3 or 0,2.",
    only_nodes=True,
    check=_check,
)
LOG_RATE_LIMIT = Setting[RateLimit | None](
    "log_rate_limit",
    one_text(str, "LINES/TIME such as 1000/1s", "LINES/TIME", parse_rate, format_rate),
    None,
    "Log lines per time to keep of each node; the rest is dropped and counted.",
    per_node=True,
)
LIVE_SETTINGS: tuple[Setting[Any], ...] = (
    *(_limit_setting(key, help_text) for key, help_text in _HELPS.items()),
    CPUS,
)
"""Settings that can be changed while the dataflow is running."""

LIMIT_SETTINGS: tuple[Setting[Any], ...] = (*LIVE_SETTINGS, NICE, REALTIME, DEVICE)
RUNNER_SETTINGS = {one.name: one for one in (*LIVE_SETTINGS, NICE, LOG_RATE_LIMIT)}

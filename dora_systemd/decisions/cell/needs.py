"""What a dataflow and its nodes need before they start: the words of the setting `needs`.

A dataflow needs units, and systemd waits for them. A node needs paths and network interfaces, and
the runner waits for them. `NODE=PATH` is the need of a node where no key names the node: in a flag.
"""

import re
from collections.abc import Container, Mapping, Sequence
from functools import lru_cache
from pathlib import PurePosixPath
from typing import NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import did_you_mean, is_name, is_node_id
from dora_systemd.values import quoted

NETWORK, CLOCK = "network", "clock"
DATAFLOW, UNIT, MOUNT, NET = "dataflow:", "unit:", "mount:", "net:"
WORDS = (NETWORK, CLOCK, DATAFLOW, UNIT, MOUNT, NET)
FOREIGN = (DATAFLOW, UNIT, MOUNT)
"""Needs that make systemd start what may be another user's."""

_UNIT_NAME = re.compile(r"[A-Za-z0-9:_.\\@-]{1,240}\.(?:service|socket|target|mount|device|path)")
_INTERFACE = re.compile(r"[!-~]{1,15}")
"""At most IFNAMSIZ bytes with the final zero, as dev_valid_name() of the kernel."""
_OF_NODES = ("/", NET)
_HINT = (
    "valid values: network, clock, dataflow:NAME, unit:NAME, mount:PATH, and for a node "
    "PATH and net:INTERFACE"
)


class NodeNeed(NamedTuple):
    """What has to be there before the program of `node` is executed."""

    node: str
    what: str  # a path, or net:INTERFACE


def parse_needs(texts: Sequence[str]) -> tuple[str, ...]:
    """The needs in their shortest form, each once. Raises DoraSystemdError (USAGE)."""
    return tuple(dict.fromkeys(_parse_need(text.strip()) for text in texts))


def _parse_need(text: str) -> str:
    if text in (NETWORK, CLOCK):
        return text
    kind, colon, value = text.partition(":")
    if colon and kind in _PARSERS:
        return f"{kind}:{_PARSERS[kind](value, text)}"
    node, equals, what = text.partition("=")
    if text.startswith("/"):
        return _parse_path(text, text)
    if equals and is_node_id(node) and what.startswith("/"):
        return f"{node}={_parse_path(what, text)}"
    if equals and is_node_id(node) and what.startswith(NET):
        return f"{node}={NET}{_parse_interface(what.removeprefix(NET), text)}"
    raise _refusal(text, did_you_mean(text, WORDS) or _HINT)


def _parse_name(value: str, text: str) -> str:
    if not is_name(value):
        raise _refusal(text, "write the name of a dataflow, as `doractl list` shows it")
    return value


def _parse_unit(value: str, text: str) -> str:
    if not _UNIT_NAME.fullmatch(value):
        raise _refusal(text, "write the whole name of a unit, such as unit:postgresql.service")
    return value


def _parse_path(value: str, text: str) -> str:
    path = PurePosixPath(value)
    is_plain = value.isprintable() and ".." not in path.parts and "%" not in value
    if not is_plain or not path.is_absolute() or str(path) in ("/", "//"):
        raise _refusal(text, "write an absolute path without '..' and '%', such as /dev/video0")
    return f"/{str(path).lstrip('/')}"


def _parse_interface(value: str, text: str) -> str:
    if not _INTERFACE.fullmatch(value) or value in (".", "..") or {*value} & {*"/:%"}:
        hint = "write the name of a network interface, such as net:can0: 1 to 15 characters"
        raise _refusal(text, f"{hint}, without blanks, '/', ':' and '%'")
    return value


_PARSERS = {
    "dataflow": _parse_name,
    "unit": _parse_unit,
    "mount": _parse_path,
    "net": _parse_interface,
}


def _refusal(text: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(f"cannot wait for {quoted(text)}", hint, ExitCode.USAGE)


def needs_by_node(
    given: tuple[str, ...], by_node: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """The needs of each node.

    given: of the dataflow, and with a node in front. by_node: from `nodes:` in settings files.
    Raises DoraSystemdError (BAD_INPUT) for a path or an interface that the dataflow needs, and for
    a unit that a node needs.
    """
    if lonely := next((one for one in given if one.startswith(_OF_NODES)), None):
        kind = "a network interface" if lonely.startswith(NET) else "a path"
        raise DoraSystemdError(
            f"cannot wait for {quoted(lonely)}: {kind} is what a node needs",
            f"write nodes: NODE: needs: {lonely}, or --needs NODE={lonely}",
            ExitCode.BAD_INPUT,
        )
    for node, texts in by_node.items():
        _check_of_node(node, texts)
    found = dict(by_node)
    for node, what in (one.split("=", 1) for one in given if _is_of_node(one)):
        found[node] = tuple(dict.fromkeys((*found.get(node, ()), what)))
    return found


def _is_of_node(need: str) -> bool:
    node, equals, what = need.partition("=")
    return bool(equals) and is_node_id(node) and what.startswith(_OF_NODES)


def _check_of_node(node: str, needs: Sequence[str]) -> None:
    if wrong := next((one for one in needs if not one.startswith(_OF_NODES)), None):
        raise DoraSystemdError(
            f"node {node} cannot wait for {quoted(wrong)}: a node needs paths and net:INTERFACE",
            f"write needs: {wrong} outside of nodes:, for the whole dataflow"
            if not _is_of_node(wrong)
            else f"write {wrong.partition('=')[2]} alone",
            ExitCode.BAD_INPUT,
        )


@lru_cache(maxsize=4)
def needs_of(options: RunnerOptions) -> tuple[NodeNeed, ...]:
    """What single nodes wait for. Raises DoraSystemdError."""
    needs = options.by_node("needs")
    return tuple(NodeNeed(node, what) for node, own in needs.items() for what in own)


def check_needs(needs: Sequence[NodeNeed], launched: Container[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a need of a node that our launcher does not start."""
    if other := next((one for one in needs if one.node not in launched), None):
        raise DoraSystemdError(
            f"node {other.node} cannot wait for {other.what}: dora itself starts this node",
            "operators, ros2, dynamic nodes and path_sha256: write needs: for another node",
            ExitCode.BAD_INPUT,
        )

"""What a dataflow and its nodes need before they start: the words of the setting `needs`.

A dataflow needs units, and systemd waits for them. A node needs paths and network interfaces, and
the runner waits for them.
"""

import re
from collections.abc import Container, Sequence
from functools import lru_cache
from pathlib import PurePosixPath
from typing import NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import did_you_mean, is_name
from dora_systemd.values import quoted

NETWORK, CLOCK = "network", "clock"
DATAFLOW, UNIT, MOUNT, NET = "dataflow:", "unit:", "mount:", "net:"
WORDS = (NETWORK, CLOCK, DATAFLOW, UNIT, MOUNT, NET)
FOREIGN = (DATAFLOW, UNIT, MOUNT)
"""Needs that make systemd start what may be another user's."""

_UNIT_NAME = r"[A-Za-z0-9:_.\\@-]{1,240}\.(?:service|socket|target|mount|device|path)"
_INTERFACE = r"[!-~]{1,15}"
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
    """Parse what a dataflow needs: each once, in its shortest form.

    Raises DoraSystemdError (USAGE).
    """
    needs = _parse_all(texts)
    if lonely := next((one for one in needs if one.startswith(_OF_NODES)), None):
        kind = "a network interface" if lonely.startswith(NET) else "a path"
        hint = f"write nodes: NODE: needs: {lonely}, or --node NODE:needs={lonely}"
        raise _refusal(lonely, hint, f": {kind} is what a node needs")
    return needs


def parse_node_needs(texts: Sequence[str]) -> tuple[str, ...]:
    """The needs of a node in their shortest form, each once. Raises DoraSystemdError (USAGE)."""
    needs = _parse_all(texts)
    if wrong := next((one for one in needs if not one.startswith(_OF_NODES)), None):
        hint = f"write needs: {wrong} outside of nodes:, for the whole dataflow, or --needs {wrong}"
        raise _refusal(wrong, hint, ": a node needs paths and net:INTERFACE")
    return needs


def _parse_all(texts: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(_parse_need(text.strip()) for text in texts))


def _parse_need(text: str) -> str:
    if text in (NETWORK, CLOCK):
        return text
    kind, colon, value = text.partition(":")
    if colon and kind in _PARSERS:
        return f"{kind}:{_PARSERS[kind](value, text)}"
    if text.startswith("/"):
        return _parse_path(text, text)
    raise _refusal(text, did_you_mean(text, WORDS) or _HINT)


def _parse_name(value: str, text: str) -> str:
    if not is_name(value):
        raise _refusal(text, "write the name of a dataflow, as `doractl list` shows it")
    return value


def _parse_unit(value: str, text: str) -> str:
    if not re.fullmatch(_UNIT_NAME, value):
        raise _refusal(text, "write the whole name of a unit, such as unit:postgresql.service")
    return value


def _parse_path(value: str, text: str) -> str:
    path = PurePosixPath(value)
    is_plain = value.isprintable() and ".." not in path.parts and "%" not in value
    if not is_plain or not path.is_absolute() or str(path) in ("/", "//"):
        raise _refusal(text, "write an absolute path without '..' and '%', such as /dev/video0")
    return f"/{str(path).lstrip('/')}"


def _parse_interface(value: str, text: str) -> str:
    if not re.fullmatch(_INTERFACE, value) or value in (".", "..") or {*value} & {*"/:%"}:
        hint = "write the name of a network interface, such as net:can0: 1 to 15 characters"
        raise _refusal(text, f"{hint}, without blanks, '/', ':' and '%'")
    return value


_PARSERS = {
    "dataflow": _parse_name,
    "unit": _parse_unit,
    "mount": _parse_path,
    "net": _parse_interface,
}


def _refusal(text: str, hint: str, reason: str = "") -> DoraSystemdError:
    return usage_error(f"cannot wait for {quoted(text)}{reason}", hint)


@lru_cache(maxsize=4)
def needs_of(options: RunnerOptions) -> tuple[NodeNeed, ...]:
    """What single nodes wait for. Raises DoraSystemdError."""
    needs = options.by_node("needs")
    return tuple(NodeNeed(node, what) for node, own in needs.items() for what in own)


def check_needs(needs: Sequence[NodeNeed], launched: Container[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a need of a node that our launcher does not start."""
    if other := next((one for one in needs if one.node not in launched), None):
        raise bad_input(
            f"node {other.node} cannot wait for {other.what}: dora itself starts this node",
            "operators, ros2, dynamic nodes and path_sha256: write needs: for another node",
        )

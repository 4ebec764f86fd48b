"""Which machine runs which node, where a dataflow has several, and which ones are missing. Pure.

The machine on which `doractl start` runs is the head. Every other one is a member, and has a name.
They are part of the runner's command line, which `list` parses: imports only what loads quickly.
"""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import is_name, is_node_id
from dora_systemd.values import quoted

HEAD = "head"
"""The machine of a node that runs on the head, where a word is needed; no member has this name."""
_HOST_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,252}"


class Placed(NamedTuple):
    """A node that runs on the member `machine`."""

    node: str
    machine: str


def parse_placed(text: str) -> Placed:
    """A NODE=MACHINE of the runner's command line. Raises DoraSystemdError (USAGE)."""
    node, equals, machine = text.partition("=")
    if not equals or not is_node_id(node):
        raise _refusal(text, "write NODE=MACHINE")
    return Placed(node, parse_machine(machine))


def parse_machine(text: str) -> str:
    """The name of a member. Raises DoraSystemdError (USAGE)."""
    if not is_name(text) or text == HEAD:
        raise _refusal(text, f"a machine has a name like a dataflow, and not {HEAD}")
    return text


def is_host_name(text: str) -> bool:
    """Return whether a text can be the host name of the head."""
    return re.fullmatch(_HOST_NAME, text) is not None


def parse_head(text: str) -> str:
    """The host name of the head, or "". Raises DoraSystemdError (USAGE)."""
    if text and not is_host_name(text):
        raise _refusal(text, "write the host name of the head")
    return text


def members_of(placed: Sequence[Placed]) -> tuple[str, ...]:
    """The members, each once, in the order of the dataflow."""
    return tuple(dict.fromkeys(one.machine for one in placed))


def machine_of(placed: Sequence[Placed], node: str) -> str:
    """The member that runs the node, or HEAD."""
    return placed_on(placed, node) or HEAD


def placed_on(placed: Sequence[Placed], node: str) -> str:
    """The member that runs the node, or ""."""
    return next((one.machine for one in placed if one.node == node), "")


def _refusal(text: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot use {quoted(text)} as a machine", hint)


NOT_CONNECTED = "it is not connected yet"
NOT_JOINED = "it has not answered yet"
USUAL = (NOT_CONNECTED, NOT_JOINED)
"""Reasons for which each start waits a moment."""
ENDED = "the connection has ended"
"""The reason of a lost connection until the link reports a better one."""
_BEGIN = "waiting for machine"


def format_missing(missing: Mapping[str, str]) -> str:
    """The machines that are missing, by name, and why."""
    word = "machine" if len(missing) == 1 else "machines"
    return f"{word} {', '.join(f'{name} ({why})' for name, why in missing.items())}"


def is_news(text: str) -> bool:
    """Whether the stage of a start is more than what each start waits for."""
    for one in (*USUAL, ENDED):
        text = text.replace(f"({one})", "")
    return text.startswith(_BEGIN) and "(" in text

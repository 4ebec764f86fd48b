"""The dora command: variables by which it finds a coordinator, and its restarts of a node. Pure.

dora itself would count `dora node restart` among the restarts that the policy of the node allows.
"""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.status import RESTART, STOP
from dora_systemd.values import parse_duration

VARIABLES = (
    "DORA_COORDINATOR_ADDR",
    "DORA_COORDINATOR_PORT",
    "DORA_AUTH_TOKEN",
    "DORA_DAEMON_LOCAL_LISTEN_PORT",
)
"""The variables that dora 1.1 reads and `doractl env` sets; the last one is for dynamic nodes."""

SHELLS = {"sh": ("export {0}={1}", "unset {0}"), "fish": ("set -gx {0} {1}", "set -e {0}")}
"""Commands that set and unset a variable. sh: also for bash and zsh."""


def coordinator_variables(
    port: int, token: str, local_listen_port: int | None = None
) -> dict[str, str]:
    """The variables for a coordinator on this port of 127.0.0.1."""
    values = ("127.0.0.1", str(port), token)
    found = dict(zip(VARIABLES, values, strict=False))
    return found if local_listen_port is None else {**found, VARIABLES[-1]: str(local_listen_port)}


def format_exports(shell: str, values: Mapping[str, str]) -> str:
    """Lines that set these variables and unset the others of VARIABLES."""
    set_line, _ = SHELLS[shell]
    lines = [set_line.format(name, shlex.quote(value)) for name, value in values.items()]
    others = [name for name in VARIABLES if name not in values]
    return "\n".join([*lines, *([format_unsets(shell, others)] if others else [])])


def format_unsets(shell: str, names: Iterable[str] = VARIABLES) -> str:
    """Commands that unset them."""
    return "\n".join(SHELLS[shell][1].format(name) for name in names)


_DURATION = r"[0-9]{1,9}(ms|s|min)?"
_DATAFLOW, _GRACE = ("-d", "--dataflow"), ("--grace",)
_TOLD = {RESTART: "Node `{}` restart initiated", STOP: "Node `{}` stopped"}


class NodeCommand(NamedTuple):
    """One such command."""

    what: str
    node: str
    dataflow: str = ""  # its name or UUID, "" if it is not given
    grace: int | None = None  # µs, or None

    @property
    def told(self) -> str:
        """The text that dora prints for the command."""
        return _TOLD[self.what].format(self.node)


def parse_node_command(arguments: Sequence[str]) -> NodeCommand | None:
    """The command, or None for another one, and for options that only dora itself knows."""
    verb, rest = tuple(arguments[:2]), list(arguments[2:])
    if verb not in (("node", RESTART), ("node", STOP)):
        return None
    nodes, dataflow, grace = [], "", ""
    while rest:
        word, *rest = rest
        key, has_value, value = word.partition("=")
        if key in (*_DATAFLOW, *_GRACE):
            if not has_value:
                if not rest:
                    return None
                value, *rest = rest
            dataflow, grace = (value, grace) if key in _DATAFLOW else (dataflow, value)
        elif word.startswith("-"):
            return None
        else:
            nodes.append(word)
    if len(nodes) != 1 or not (grace == "" or re.fullmatch(_DURATION, grace)):
        return None
    return NodeCommand(verb[1], nodes[0], dataflow, parse_duration(grace) if grace else None)

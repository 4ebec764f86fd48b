"""Recognizes `dora node restart` and `dora node stop` in a command line for dora. Pure.

dora itself would count such a restart among those that the policy of the node allows.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.asked import RESTART, STOP
from dora_systemd.values import parse_duration

_DURATION = re.compile(r"[0-9]{1,9}(ms|s|min)?")
_DATAFLOW, _GRACE = ("-d", "--dataflow"), ("--grace",)
_TOLD = {RESTART: "Node `{}` restart initiated", STOP: "Node `{}` stopped"}


class NodeCommand(NamedTuple):
    """One such command. dataflow: its name or UUID, "" if it is not given. grace: µs, or None."""

    what: str
    node: str
    dataflow: str = ""
    grace: int | None = None

    @property
    def told(self) -> str:
        """What dora prints for it."""
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
    if len(nodes) != 1 or not (grace == "" or _DURATION.fullmatch(grace)):
        return None
    return NodeCommand(verb[1], nodes[0], dataflow, parse_duration(grace) if grace else None)

"""Nodes that the runner adds to a dataflow: they receive messages, and nobody shall see them.

`PROBE` and `RECORDER` are their names: the cgroup is node-NAME, and dora's id has it.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dora_systemd.errors import bad_input
from dora_systemd.values import quoted

PROBE = "dora-systemd-probe"
"""Receives the outputs that are owed, see decisions/owes/probe.py."""
RECORDER = "dora-systemd-recorder"
"""Receives the outputs that are recorded, see decisions/recorder/ring.py."""
EXTRA = (PROBE, RECORDER)
# The daemon sends a message to its receivers in the order of their ids. With an id at the end of
# this order a recorder adds 10 % to the latency of 64 B, and 20 % with one before it.
_LAST = "zzz-"
ID_PREFIX = f"{_LAST}dora-systemd-"
"""Of each of them."""


def extra_id(name: str, number: int) -> str:
    """Make dora's id of an added node. number: of earlier nodes of that name in this run."""
    return f"{_LAST}{name}.{number}"


def is_extra(node: str, name: str) -> bool:
    """Whether a node of this id is an added one, or would have the cgroup of one."""
    return node.removeprefix(_LAST).startswith(name)


def check_ids(what: str, name: str, nodes: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if a node of the dataflow has the id of an added one.

    what: the purpose of that, as in "record outputs". name: PROBE or RECORDER. nodes: their ids.
    """
    for one in nodes:
        if is_extra(one, name):
            message = f"cannot {what}: the node {quoted(one)} has a name that doractl needs"
            raise bad_input(message, "give that node another id")


def without_extra(nodes: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Of the nodes in a descriptor of dora's, those of the dataflow."""
    return [one for one in nodes if not any(is_extra(str(one.get("id")), name) for name in EXTRA)]

"""A record that says where lines are that the journal here does not have. Pure.

The gateway has no way to other machines: it has no keys, and its unit no network.
"""

from collections.abc import Sequence

from dora_systemd.decisions.cell.machines import Placed, members_of
from dora_systemd.decisions.logs.records import Record

_NOTICE = b"5"


def lines_elsewhere(name: str, placed: Sequence[Placed], node: str, at_us: int) -> list[Record]:
    """One record for a dataflow, or a node, with lines on other machines; else none.

    node: "" for all. at_us: now, CLOCK_REALTIME.
    """
    away = [one for one in placed if node in ("", one.node)]
    if not away:
        return []
    machines = members_of(away)
    where = f"machine {machines[0]}" if len(machines) == 1 else f"machines {', '.join(machines)}"
    which = f" --node {node}" if node else ""
    text = f"more lines are in the journal of {where}: doractl logs {name}{which}"
    return [
        {
            "__REALTIME_TIMESTAMP": b"%d" % at_us,
            "MESSAGE": text.encode(),
            "PRIORITY": _NOTICE,
            **({"DORA_NODE": node.encode()} if node else {}),
        }
    ]

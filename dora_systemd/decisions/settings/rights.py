"""The settings of rights that single nodes have, see dora_systemd.decisions.cell.rights."""

from collections.abc import Sequence
from typing import Any

from dora_systemd.decisions.cell.launch import has_launcher
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import (
    RAISES,
    check_launched,
    check_rights_nodes,
    parse_oom,
    parse_scheduling,
    rights_of,
)
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.settings.kinds import BOOL, Kind, Setting, one_text


def check_rights(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for rights of a node that cannot have them."""
    check_rights_nodes(rights_of(options), {node.id for node in nodes if has_launcher(node)})


def _check_core_dumps(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    launched = {node.id for node in nodes if has_launcher(node)}
    check_launched("cannot set core_dumps of", options.by_node("core_dumps"), launched)


def _of_node(
    key: str, kind: Kind[Any], help_text: str, default: Any = None, on_head: bool = False
) -> Setting[Any]:
    return Setting(
        *(key, kind, default, help_text),
        only_nodes=True,
        raises=RAISES[key],
        on_head=on_head,
        check=check_rights,
    )


SCHEDULING: Setting[str | None] = _of_node(
    "scheduling",
    one_text(str, "a policy such as fifo:50 or batch", "POLICY", parse_scheduling),
    "Scheduling of the node: fifo:PRIORITY, rr:PRIORITY, batch, idle or other; see sched(7).",
)
LOCK_MEMORY: Setting[bool] = _of_node(
    "lock_memory", BOOL, "The node may lock all of its memory, see mlockall(2).", False
)
OOM_SCORE_ADJUST: Setting[int | None] = _of_node(
    "oom_score_adjust",
    one_text(int | str, "a number from -1000 to 1000", "N", parse_oom),
    "How soon the kernel kills the node when memory is short, -1000 to 1000.",
)
ESSENTIAL: Setting[bool] = _of_node(
    "essential",
    BOOL,
    "The final failure of the node ends the dataflow, and its memory goes last.",
    False,
    on_head=True,
)
CORE_DUMPS = Setting[bool](
    "core_dumps",
    BOOL,
    True,
    "Keep the core dumps of the node, see core(5); the node restarts when its dump is written.",
    only_nodes=True,
    check=_check_core_dumps,
)
RIGHTS_SETTINGS: tuple[Setting[Any], ...] = (
    *(SCHEDULING, LOCK_MEMORY, OOM_SCORE_ADJUST, ESSENTIAL, CORE_DUMPS),
)
RUNNER_SETTINGS = {one.name: one for one in RIGHTS_SETTINGS}

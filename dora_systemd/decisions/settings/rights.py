"""The settings of rights that single nodes have, see dora_systemd.decisions.cell.rights."""

from typing import Any

from dora_systemd.decisions.cell.rights import (
    BY_KEY,
    RIGHTS,
    NodeRights,
    format_node_rights,
    merge_node_rights,
    parse_node_rights,
    raises_rights,
)
from dora_systemd.decisions.settings.kinds import BOOL, Kind, Setting, one_text, texts_of_nodes


def _of_node(key: str, kind: Kind[Any], help_text: str, default: Any = None) -> Setting[Any]:
    raises = BY_KEY[key].raises
    return Setting(key, kind, default, help_text, only_nodes=True, raises=raises)


NODE_RIGHTS = Setting[tuple[NodeRights, ...]](
    "node_rights",
    texts_of_nodes(
        "NODE:scheduling=fifo:50,nice=-5",
        "NODE:RIGHT=VALUE,...",
        parse_node_rights,
        format_node_rights,
        merge_node_rights,
    ),
    (),
    f"Rights of one node: {', '.join(right.word for right in RIGHTS)}.",
    raises=lambda rights: any(map(raises_rights, rights)),
)
SCHEDULING: Setting[str | None] = _of_node(
    "scheduling",
    one_text(str, "a policy such as fifo:50 or batch", "POLICY", BY_KEY["scheduling"].parse),
    "Scheduling of the node: fifo:PRIORITY, rr:PRIORITY, batch, idle or other; see sched(7).",
)
LOCK_MEMORY: Setting[bool] = _of_node(
    "lock_memory", BOOL, "The node may lock all of its memory, see mlockall(2).", False
)
OOM_SCORE_ADJUST: Setting[int | None] = _of_node(
    "oom_score_adjust",
    one_text(int | str, "a number from -1000 to 1000", "N", BY_KEY["oom_score_adjust"].parse),
    "How soon the kernel kills the node when memory is short, -1000 to 1000.",
)
ESSENTIAL: Setting[bool] = _of_node(
    "essential",
    BOOL,
    "The final failure of the node ends the dataflow, and its memory goes last.",
    False,
)
RIGHTS_SETTINGS: tuple[Setting[Any], ...] = (
    *(NODE_RIGHTS, SCHEDULING, LOCK_MEMORY, OOM_SCORE_ADJUST, ESSENTIAL),
)

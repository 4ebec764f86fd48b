"""The settings of rights that single nodes have, see dora_systemd.decisions.rights.node_rights."""

from typing import Any

from dora_systemd.decisions.rights.node_rights import (
    BY_KEY,
    RIGHTS,
    NodeRights,
    format_node_rights,
    merge_node_rights,
    parse_node_rights,
    raises_rights,
)
from dora_systemd.decisions.settings.kinds import BOOL, Setting, many_texts, one_text

NODE_RIGHTS = Setting[tuple[NodeRights, ...]](
    "node_rights",
    many_texts(
        "NODE:scheduling=fifo:50,nice=-5 or a list of such texts",
        "NODE:RIGHT=VALUE,...",
        lambda texts: merge_node_rights(map(parse_node_rights, texts)),
        lambda rights: list(map(format_node_rights, rights)),
        merge_node_rights,
    ),
    (),
    f"Rights of one node: {', '.join(right.word for right in RIGHTS)}.",
    raises=lambda rights: any(map(raises_rights, rights)),
)
SCHEDULING = Setting[str | None](
    "scheduling",
    one_text(
        str, "a policy such as fifo:50 or batch", "POLICY[:PRIORITY]", BY_KEY["scheduling"].parse
    ),
    None,
    "Scheduling of the node: fifo:PRIORITY, rr:PRIORITY, batch, idle or other; see sched(7).",
    only_nodes=True,
    raises=BY_KEY["scheduling"].raises,
)
LOCK_MEMORY = Setting[bool](
    "lock_memory",
    BOOL,
    False,
    "The node may lock all of its memory, see mlockall(2).",
    only_nodes=True,
    raises=BY_KEY["lock_memory"].raises,
)
OOM_SCORE_ADJUST = Setting[int | None](
    "oom_score_adjust",
    one_text(int | str, "a number from -1000 to 1000", "N", BY_KEY["oom_score_adjust"].parse),
    None,
    "How soon the kernel kills the node when memory is short, -1000 to 1000.",
    only_nodes=True,
    raises=BY_KEY["oom_score_adjust"].raises,
)
ESSENTIAL = Setting[bool](
    "essential",
    BOOL,
    False,
    "The final failure of the node ends the dataflow, and its memory goes last.",
    only_nodes=True,
)
RIGHTS_SETTINGS: tuple[Setting[Any], ...] = (
    *(NODE_RIGHTS, SCHEDULING, LOCK_MEMORY, OOM_SCORE_ADJUST, ESSENTIAL),
)

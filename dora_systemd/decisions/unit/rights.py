"""What a unit grants all of its processes so that one node can have it, see systemd.exec(5)."""

from collections.abc import Sequence

from dora_systemd.decisions.properties.assignments import with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.rights.commands import NICE_LIMIT
from dora_systemd.decisions.rights.node_rights import NodeRights


def rights_properties(rights: Sequence[NodeRights]) -> dict[str, Property]:
    """LimitRTPRIO=, LimitNICE= and OOMScoreAdjust=; the launcher takes them from the other nodes.

    The runner and dora keep them. Without dora there is no node, so its memory goes last as well.
    """
    priority = max((one.priority for one in rights), default=0)
    nice = min((one.nice or 0 for one in rights), default=0)
    oom = min((one.oom_score_adjust or 0 for one in rights), default=0)
    texts = {
        "LimitRTPRIO": priority,
        "LimitNICE": NICE_LIMIT - nice if nice < 0 else 0,
        "OOMScoreAdjust": min(oom, 0),
    }
    return with_assignments({}, [f"{key}={number}" for key, number in texts.items() if number])

"""Rights that nodes can have, for property tests."""

from typing import Any

from hypothesis import strategies as st

from dora_systemd.decisions.cell.rights import NodeRights
from dora_systemd.decisions.settings.table import NODES

REALTIME = st.builds("{}:{}".format, st.sampled_from(["rr", "fifo"]), st.integers(1, 99))
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "scheduling": REALTIME | st.sampled_from(["batch", "idle", "other"]),
    "nice": st.integers(-20, 19),
    "lock_memory": st.booleans(),
    "oom_score_adjust": st.integers(-1000, 1000),
    "essential": st.booleans(),
}


def rights_from(text: str) -> NodeRights:
    """The rights of a node, as --node takes them."""
    ((node, values),) = NODES.kind.parse([text], None).items()
    return NodeRights(node, **values)


RIGHTS_VALUES: dict[str, st.SearchStrategy[Any]] = {
    **{key: VALUES[key] for key in ("scheduling", "oom_score_adjust")},
}
"""By name of the setting; switches have none."""

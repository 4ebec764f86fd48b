"""Rights that nodes can have, for property tests."""

from typing import Any

from hypothesis import strategies as st

from dora_systemd.decisions.cell.rights import NodeRights
from tests.unit.fakes.limit_values import IDS

REALTIME = st.builds("{}:{}".format, st.sampled_from(["rr", "fifo"]), st.integers(1, 99))
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "scheduling": REALTIME | st.sampled_from(["batch", "idle", "other"]),
    "nice": st.integers(-20, 19),
    "lock_memory": st.booleans(),
    "oom_score_adjust": st.integers(-1000, 1000),
    "essential": st.booleans(),
}


@st.composite
def rights_of_a_node(draw: st.DrawFn) -> NodeRights:
    """Rights of some node, one at least."""
    keys = draw(st.sets(st.sampled_from(sorted(VALUES)), min_size=1))
    return NodeRights(draw(IDS), **{key: draw(VALUES[key]) for key in sorted(keys)})


RIGHTS_VALUES: dict[str, st.SearchStrategy[Any]] = {
    **{key: VALUES[key] for key in ("scheduling", "oom_score_adjust")},
    "node_rights": st.lists(rights_of_a_node(), unique_by=lambda one: one.node).map(tuple),
}
"""By name of the setting; switches have none."""

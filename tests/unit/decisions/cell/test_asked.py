"""What somebody has asked for is no crash."""

import pytest

from dora_systemd.decisions.cell.asked import format_stopped, is_stopped, was_asked
from dora_systemd.decisions.cell.status import NODE_STATES, NodeStatus

ROOT, PAGE = "root (doractl node stop)", "root (status page)"


@pytest.mark.parametrize("state", NODE_STATES)
@pytest.mark.parametrize("asked", ["", "restart", "stop"])
def test_whether_an_end_was_asked_for(state: str, asked: str) -> None:
    """Every pair: a stop covers all ends, a restart the one process that it ends."""
    node = NodeStatus(state, asked=asked)
    assert was_asked(node) == (asked == "stop" or (asked, state) == ("restart", "reloading"))
    assert is_stopped(node) == (asked == "stop")


@pytest.mark.parametrize(
    ("stopped", "text"),
    [
        ({}, ""),
        ({"a": ""}, ""),
        ({"a": ROOT, "b": "", "c": ROOT}, f"a, c, requested by {ROOT}"),
        ({"a": ROOT, "b": PAGE}, f"a, requested by {ROOT}; b, requested by {PAGE}"),
    ],
)
def test_who_has_stopped_what(stopped: dict[str, str], text: str) -> None:
    assert format_stopped(stopped) == text

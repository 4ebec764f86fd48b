"""Events are values: equal if kind and fields are, and never changed."""

from dataclasses import replace
from typing import cast

import pytest

from dora_systemd.decisions.life.events import AllReady, Event, NodeMet, NodeReady, RunFinished


def test_events_are_equal_by_kind_and_fields() -> None:
    ready = NodeReady(1, "camera")
    assert ready == NodeReady(1, "camera")
    assert len({ready, NodeReady(1, "camera")}) == 1
    others = [NodeReady(2, "camera"), NodeReady(1, "plot"), NodeMet(1, "camera"), Event(1)]
    assert ready not in others
    assert cast(Event, AllReady(1)) != RunFinished(1)
    assert replace(ready, node="plot") == NodeReady(1, "plot")


def test_an_event_shows_its_kind_and_fields() -> None:
    assert repr(NodeReady(1, "camera")) == "NodeReady{'at_us': 1, 'node': 'camera'}"


def test_events_do_not_change() -> None:
    ready = NodeReady(1, "camera")
    with pytest.raises(AttributeError, match="node"):
        ready.node = "plot"  # type: ignore[misc]

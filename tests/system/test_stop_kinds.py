"""All that stops a dataflow keeps its order: `make stops` does it often, and restarts a machine.

The kinds, and what must hold after each, are in tests/stops/kinds.py.
"""

from collections.abc import Iterator

import pytest

from tests.stops.kinds import Story, Table
from tests.system.cells import Cell, Project
from tests.system.recorders import CRASHES

# They write to /etc and /var/lib, and open the port.
pytestmark = pytest.mark.lab


KINDS = (
    *("doractl restart", "reload", "failure", "dora stop"),
    *("stop before a deploy", "deploy", "rollback", "destroy"),
)
"""The others are as one of these, or in test_stop_order.py."""


@pytest.fixture
def story(cell: Cell, project: Project) -> Iterator[Story]:
    story = Story(cell, project, Table())
    story.begin()
    yield story
    story.end()


@pytest.mark.warns(
    *CRASHES, "crashed: signal SIGKILL", "failed: essential node", "Failed with result"
)
def test_each_kind_of_stop_loses_nothing(story: Story) -> None:
    wrong = {kind: story.stop(kind) for kind in KINDS}
    assert not any(wrong.values()), wrong

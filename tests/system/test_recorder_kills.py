"""kill -9 of what records and what is recorded, see recorder_kills.py."""

import os
import random

import pytest

from tests.system.cells import Cell, Project
from tests.system.recorder_kills import WHO, Scene, read_strictly, table
from tests.system.test_record import LARGE

pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("ROUNDS", "8"))
KILLED = (
    *("killed", "signal", "SIGKILL", "is lost", "failed", "crashed", "restart"),
    *("exited with error", "Failed with result", "nobody records", LARGE, "connection"),
)


@pytest.mark.warns(*KILLED)
def test_a_bundle_has_the_last_messages(cell: Cell, project: Project) -> None:
    """Other readers than ours find nothing wrong in its recording, and do so in a damaged one."""
    scene = Scene(cell, project, random.Random())
    scene.begin()
    rounds = [scene.kill(WHO[number % len(WHO)]) for number in range(ROUNDS)]
    print(table(rounds))
    assert not [str(one) for one in rounds if one.wrong]
    middle = len(scene.data) // 2
    damaged = scene.data[:middle] + bytes([scene.data[middle] ^ 1]) + scene.data[middle + 1 :]
    with pytest.raises(ValueError, match="crc validation failed"):
        read_strictly(damaged)
    assert read_strictly(scene.data).damaged == 0

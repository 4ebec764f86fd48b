"""kill -9 of doractl at any moment of a deploy or rollback, see kills.py."""

import os
import random

import pytest

from tests.system.cells import Project
from tests.system.deploy.kills import Scene, kill, table
from tests.system.releases import Releases

pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("ROUNDS", "8"))


def test_it_can_be_killed_at_any_moment(releases: Releases, project: Project) -> None:
    scene, chance = Scene(releases, project), random.Random()
    course = scene.begin()
    rounds = [kill(scene, course.moment(number, chance)) for number in range(ROUNDS)]
    print(table(rounds))
    assert not [one.wrong for one in rounds if one.wrong]

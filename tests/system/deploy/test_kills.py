"""kill -9 of doractl at any moment of a deploy or rollback, see kills.py."""

import os
import random

import pytest

from tests.system.cells import Project
from tests.system.deploy.kills import Kills, table
from tests.system.releases import Releases

pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("ROUNDS", "6"))


def test_it_can_be_killed_at_any_moment(releases: Releases, project: Project) -> None:
    kills = Kills(releases, project)
    rounds = [kills.run(one) for one in kills.moments(ROUNDS, random.Random())]
    print(table(rounds))
    assert not [one.wrong for one in rounds if one.wrong]

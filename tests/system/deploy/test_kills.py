"""kill -9 of doractl at any moment of a deploy or rollback, see kills.py."""

import os
import random
import signal

import pytest

from tests.system.cells import Project, wait_for
from tests.system.deploy.kills import Scene, kill, table
from tests.system.deploy.look import look
from tests.system.deploy.runs import begin, deploy_words
from tests.system.releases import Releases, write_version

pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("ROUNDS", "5"))


def test_it_can_be_killed_at_any_moment(releases: Releases, project: Project) -> None:
    scene, chance = Scene(releases, project), random.Random()
    course = scene.begin()
    rounds = [kill(scene, course.moment(number, chance)) for number in range(ROUNDS)]
    print(table(rounds))
    assert not [one.wrong for one in rounds if one.wrong]


def test_a_killed_trial_is_undone(releases: Releases, project: Project) -> None:
    """Although its soak is long, and although all of its process group is killed."""
    write_version(project, "old")
    releases.deploy(project.root, "--soak", "0s")
    old, cell = releases.current(), releases.cell
    write_version(project, "new")
    words = deploy_words(releases, project.root, "1h")
    with begin(releases, *words, is_group=True) as child:
        wait_for("it runs", lambda: "version new" in cell.messages("a"))
        os.killpg(child.pid, signal.SIGKILL)
    wait_for("the old one is back", lambda: look(releases).ran == old)
    releases.check_only(old)
    why = cell.doractl("why", cell.name).stdout
    assert "the command that tried it was killed" in " ".join(why.split())

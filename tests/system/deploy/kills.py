"""kill -9 of doractl at moments of deploy and rollback, and what is there afterwards.

By hand, in the lab: python -m tests.system.deploy.kills ROUNDS [SEED] prints the table.
"""

import random
import sys
import time
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.views.dataflows import format_table
from tests.lab.pace import pace
from tests.system.cells import Cell, Project
from tests.system.deploy.look import age, kind, look, release_in, unnamed
from tests.system.deploy.runs import COUNTED, begin, begin_counted, deploy_words
from tests.system.releases import ETC, Releases, write_version

HEADER = ("ROUND", "COMMAND", "MOMENT", "RAN AFTER", "LEFT", "VERDICT")


class Moment(NamedTuple):
    """When to kill: before a change of the disk, counted from 1, or after seconds."""

    command: str
    change: int = 0
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"change {self.change}" if self.change else f"{self.seconds:.2f} s"


class Round(NamedTuple):
    """What one of them led to. left: what was found, wrong: what must not be."""

    moment: Moment
    ran: str
    left: tuple[str, ...]
    wrong: tuple[str, ...]

    def row(self, number: int) -> list[str]:
        """As in HEADER."""
        verdict = "; ".join(self.wrong) or "ok"
        left = ", ".join(self.left) or "-"
        return [str(number), self.moment.command, str(self.moment), self.ran, left, verdict]


class Course(NamedTuple):
    """What a whole command does, by its name: how many changes of the disk, in which time."""

    changes: dict[str, int]
    seconds: dict[str, float]

    def moment(self, number: int, chance: random.Random) -> Moment:
        """That of a round: half of them at changes, half in time; two deploys for a rollback."""
        command = "rollback" if number % 3 == 2 else "deploy"
        if number % 2:
            return Moment(command, change=chance.randint(1, self.changes[command]))
        return Moment(command, seconds=chance.uniform(0, 1.1 * self.seconds[command]))


class Scene:
    """A dataflow with releases, the next version of its project, and commands that change them."""

    def __init__(self, releases: Releases, project: Project, version: int = 0) -> None:
        self.releases, self.project, self.version = releases, project, version

    def begin(self) -> Course:
        """Make two releases of it, which have proved themselves."""
        self.deploy()
        measured = {command: self._measure(command) for command in ("deploy", "rollback")}
        changes = {command: one[0] for command, one in measured.items()}
        return Course(changes, {command: one[1] for command, one in measured.items()})

    def words(self, command: str) -> tuple[str, ...]:
        """A command as doractl gets it: a deploy of a new version, or of the newest one but one."""
        if command == "deploy":
            self.version += 1
            write_version(self.project, str(self.version))
            return deploy_words(self.releases, self.project.root)
        current = release_in(ETC / self.releases.cell.unit)
        proved = {one.parent.name for one in self.releases.path.glob("*/proved")}
        return ("rollback", self.releases.cell.name, max(proved - {current}), "--soak", "0s")

    def deploy(self) -> None:
        """Deploy a new version; nothing else is left then."""
        self.releases.cell.doractl(*self.words("deploy"))
        found = look(self.releases)
        assert (found.left, found.wrong) == ((), ()), found

    def _measure(self, command: str) -> tuple[int, float]:
        begun = time.monotonic()
        said = begin_counted(self.releases, 0, *self.words(command)).communicate()[1]
        return int(said.rpartition(COUNTED)[2]), round(time.monotonic() - begun, 2)


def kill(scene: Scene, moment: Moment) -> Round:
    """Kill a command, look, and let the next deploy clear what is left."""
    releases = scene.releases
    before, words = look(releases), scene.words(moment.command)
    if moment.change:
        begin_counted(releases, moment.change, *words).communicate()
    else:
        with begin(releases, *words) as child:
            time.sleep(moment.seconds)  # the moment is what is tried
            child.kill()
    found = judge(scene, moment, before.current)
    scene.deploy()
    return found


def judge(scene: Scene, moment: Moment, before: str) -> Round:
    """What is there after that. before: the release that ran."""
    after = look(scene.releases)
    wrong = (*after.wrong, *unnamed(scene.releases, after.left))
    age(after.left)
    return Round(
        moment, "old" if after.ran == before else "new", tuple(map(kind, after.left)), wrong
    )


def table(rounds: list[Round]) -> str:
    """All rounds."""
    return format_table(HEADER, [one.row(number + 1) for number, one in enumerate(rounds)])


def main(count: int, seed: int) -> int:
    """Run so many rounds with a dataflow of their own; the number of those that failed."""
    project = Project(Path("/var/tmp/kills"))
    releases = Releases(Cell("kills"))
    try:
        scene, chance = Scene(releases, project), random.Random(seed)
        course = scene.begin()
        print(f"seed {seed}; {course}; pace {pace():.1f}", flush=True)
        rounds = []
        for number in range(count):
            rounds.append(kill(scene, course.moment(number, chance)))
            print("  ".join(rounds[-1].row(number + 1)), flush=True)
    finally:
        releases.end()
    print(table(rounds))
    return sum(bool(one.wrong) for one in rounds)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1))

"""kill -9 of doractl at moments of deploy and rollback, and what is there afterwards.

By hand, in the lab: python -m tests.system.deploy.kills ROUNDS [SEED] prints the table.
"""

import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.views.dataflows import format_table
from tests.lab.pace import pace
from tests.system.cells import Cell, Project, command_line, wait_for
from tests.system.deploy.runs import COUNTED, begin, begin_counted, deploy_words
from tests.system.releases import ETC, Releases, differences, write_version

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


class Kills:
    """Rounds of one dataflow, which has two proved releases at the beginning."""

    def __init__(self, releases: Releases, project: Project) -> None:
        self.releases, self.project = releases, project
        self._version = 0
        self._next_version()
        self._whole("deploy")
        # What a whole one does, and how long it takes: the moments are chosen from it.
        self.changes = {}
        self.seconds = {}
        for command in ("deploy", "rollback"):
            self.changes[command] = self._count(command)
            self.seconds[command] = self._whole(command)

    def moments(self, count: int, chance: random.Random) -> Iterator[Moment]:
        """Half of them at changes, half in time; two deploys for each rollback."""
        for number in range(count):
            command = "rollback" if number % 3 == 2 else "deploy"
            if number % 2:
                yield Moment(command, change=chance.randint(1, self.changes[command]))
            else:
                yield Moment(command, seconds=chance.uniform(0, 1.1 * self.seconds[command]))

    def run(self, moment: Moment) -> Round:
        """Kill one, look, and let the next deploy clear what is left."""
        before = self.releases.states()
        self._next_version()
        words = self._words(moment.command)
        if moment.change:
            begin_counted(self.releases, moment.change, *words).communicate()
        else:
            with begin(self.releases, *words) as child:
                time.sleep(moment.seconds)  # the moment is what is tried
                child.kill()
        unit = self.releases.cell
        wait_for("it is up or down", lambda: unit.show("ActiveState") in ("active", "failed"))
        ran = running_now(unit, self.releases.path)
        states, left = self.releases.states(), self._left()
        wrong = [*self._wrong(ran, states), *self._unnamed(left)]
        what = "old" if before.get(ran) == "current" else states.get(ran, ran)
        self._whole("deploy")
        self.releases.check_only(self.releases.current())
        return Round(moment, what, tuple(kind(path) for path in left), tuple(wrong))

    def _wrong(self, ran: str, states: dict[str, str]) -> Iterator[str]:
        """What must not be."""
        if list(states.values()).count("current") != 1:
            yield f"current: {states}"
        if states.get(ran) not in ("current", "trial"):
            yield f"{ran or 'nothing'} runs: {states.get(ran)}"
        for release in states:
            directory = self.releases.path / release
            if directory not in self._left() and (found := differences(directory)):
                yield f"{release}: {found}"

    def _left(self) -> list[Path]:
        """What a killed command has left, found without the help of doractl."""
        path, unit = self.releases.path, self.releases.cell.unit
        found = [one for one in path.iterdir() if one.name.startswith(".")]
        found += [one for one in path.iterdir() if not (one / "unit").exists()]
        found += [one for place in (ETC, self.releases.trial.parent)
                  for one in place.glob(f".{unit}.*")]  # fmt: skip
        trial = self.releases.trial
        if trial.exists() and trial.read_text() != (ETC / unit).read_text():
            found.append(trial)
        return sorted(set(found))

    def _unnamed(self, left: list[Path]) -> Iterator[str]:
        """What doctor must name and does not."""
        said = self.releases.cell.doractl("doctor", check=False).stdout
        for path in left:
            words = "on trial" if path == self.releases.trial else str(path)
            # A temporary file of a unit file may be about to get its name for a minute.
            if words not in said and kind(path) != "temporary file":
                yield f"doctor does not name {path}"

    def _next_version(self) -> None:
        self._version += 1
        write_version(self.project, str(self._version))

    def _words(self, command: str) -> tuple[str, ...]:
        if command == "deploy":
            return deploy_words(self.releases, self.project.root)
        return ("rollback", self.releases.cell.name, "--soak", "0s")

    def _whole(self, command: str) -> float:
        """Run all of it; the seconds that it took."""
        begun = time.monotonic()
        self.releases.cell.doractl(*self._words(command))
        return time.monotonic() - begun

    def _count(self, command: str) -> int:
        """The changes of the disk in all of it."""
        self._next_version()
        said = begin_counted(self.releases, 0, *self._words(command)).communicate()[1]
        return int(said.rpartition(COUNTED)[2])


def kind(path: Path) -> str:
    """A thing that is left, in words without a random number."""
    if path.name.startswith(".new-"):
        return "draft"
    if path.name.startswith(".dora-"):
        return "temporary file"
    return (
        "trial" if path.suffix == ".service" else path.name[:5] if path.name[0] == "." else "copy"
    )


def running_now(cell: Cell, store: Path) -> str:
    """The release whose supervisor process runs, "" for none; that of its command line."""
    pid = int(cell.show("MainPID"))
    _, _, path = " ".join(command_line(pid)).partition(f"{store}/") if pid else ("", "", "")
    return path.partition("/")[0]


def table(rounds: list[Round]) -> str:
    """All rounds."""
    return format_table(HEADER, [one.row(number + 1) for number, one in enumerate(rounds)])


def main(count: int, seed: int) -> int:
    """Run so many rounds with a dataflow of their own; the number of those that failed."""
    project = Project(Path("/var/tmp/kills"))
    releases = Releases(Cell("kills"))
    try:
        kills = Kills(releases, project)
        print(f"seed {seed}; changes: {kills.changes}; seconds: {kills.seconds}; pace {pace():.1f}")
        rounds = [kills.run(one) for one in kills.moments(count, random.Random(seed))]
    finally:
        releases.end()
    print(table(rounds))
    return sum(bool(one.wrong) for one in rounds)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1))

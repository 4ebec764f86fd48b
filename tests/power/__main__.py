"""python -m tests.power ROUNDS [SEED]: cuts the power while doractl changes releases.

It restarts the machine in the middle of a deploy or rollback, without a shutdown: what is not on
the disk is lost. The lab runs it again after each boot (lab run --cuts); it looks at what is there,
and begins the next round. At the end it prints a table. Exit status: 1 if a round has failed.
"""

import os
import random
import sys
import time
from pathlib import Path

from dora_systemd.decisions.views.dataflows import format_table
from tests.power.notes import PLACE, Notes, read_notes
from tests.system.cells import Cell, Project, run
from tests.system.deploy.kills import HEADER, Scene, judge
from tests.system.deploy.look import release_in
from tests.system.deploy.runs import begin, begin_counted
from tests.system.releases import ETC, Releases

ROOT = Path("/srv/power")
CUT = 'os.write(os.open("/proc/sysrq-trigger", os.O_WRONLY), b"b")'


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def prepare(scene: Scene) -> Notes:
    """Two releases, of which one runs, on a disk that a power cut leaves consistent."""
    assert list(Path("/proc/fs/jbd2").iterdir()), "the disk has no journal"
    notes = Notes(scene.begin(), scene.version)
    say(f"whole commands: {notes.course}")
    return notes


def look_back(notes: Notes, scene: Scene) -> None:
    """Note what there is after the power cut."""
    found = judge(scene, notes.moment, notes.old)
    notes.rows.append(found.row(len(notes.rows) + 1))
    notes.failed += bool(found.wrong)
    say("  ".join(notes.rows[-1]))


def cut(notes: Notes, scene: Scene, seed: int) -> None:
    """Begin a command, and cut the power in the middle of it."""
    number = len(notes.rows)
    notes.moment = notes.course.moment(number, random.Random(f"{seed} {number}"))
    notes.old = release_in(ETC / scene.releases.cell.unit)
    words = scene.words(notes.moment.command)
    notes.version = scene.version
    notes.write()
    Path("/proc/sys/kernel/sysrq").write_text("1")
    if notes.moment.change:
        begin_counted(scene.releases, notes.moment.change, *words, end=CUT).communicate()
    else:
        begin(scene.releases, *words)
        time.sleep(notes.moment.seconds)  # the moment is what is tried
    exec(CUT, {"os": os})


def end(notes: Notes, scene: Scene) -> int:
    """The next deploy clears all that is left; print the table."""
    scene.deploy()
    scene.releases.end()
    PLACE.unlink()
    say(format_table(HEADER, notes.rows))
    say(f"{len(notes.rows)} power cuts, {notes.failed} failed")
    return int(notes.failed > 0)


def main(count: int, seed: int) -> int:
    """Look back, and cut the power again; returns after so many rounds."""
    releases, notes = Releases(Cell("power")), read_notes()
    scene = Scene(releases, Project(ROOT, is_new=notes is None), notes.version if notes else 0)
    if notes is None:
        notes = prepare(scene)
    else:
        run("systemctl", "is-system-running", "--wait", check=False)
        look_back(notes, scene)
    if len(notes.rows) >= count:
        return end(notes, scene)
    cut(notes, scene, seed)
    raise SystemExit("the power is still there")


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1))

"""python -m tests.stops COUNT: so many stops of all kinds, and the table of what was lost.

In a machine that restarts in between, it goes on where it was, and counts the reboot as a stop.
Exit status: 1 if anything was lost.
"""

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

from tests.stops.kinds import REBOOT, Story, Table, next_kinds, read_table
from tests.system.cells import Cell, Project, run

NOTES = Path("/var/lib/dora-systemd-stops.json")
ROOT = Path("/srv/stops/project")


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def main(count: int) -> int:
    """Make so many stops."""
    table = read_table(NOTES)
    ROOT.parent.mkdir(exist_ok=True)
    story = Story(Cell("stops"), Project(ROOT, is_new=table is None), table or Table())
    if table is None:
        story.begin()
    else:
        run("systemctl", "is-system-running", "--wait", check=False)
        say(f"{REBOOT} {story.judge(REBOOT)}")
    for kind in next_kinds(story.table, count):
        say(f"{kind} {story.stop(kind)}")
    say(str(story.table))
    NOTES.write_text(json.dumps(asdict(story.table)))
    os.sync()
    return int(any(story.table.lost.values()))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))

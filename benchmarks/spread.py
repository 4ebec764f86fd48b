"""The same dataflow on one machine and on two.  `LAB=machines`, `python -m benchmarks.spread [N]`

A link is one login by ssh, so that is measured as well: no start over two machines can take less.
Memory is that of all processes of a link, at both ends.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.flows import CHECKOUT
from benchmarks.rounds import OURS, Figure, alternate, keep, shown
from tests.machines.wires import there
from tests.system.cells import SINK, SOURCE, Cell, Project, run, wait_for

HOME = Path("/srv/bench")
NAME = "spread"
MEMBER = "b"
ONE, LOGIN = "one machine", "ssh b true"
_YAML = """nodes:
  - {{id: source, path: source.py, inputs: {{tick: dora/timer/millis/50}}, outputs: [number]}}
  - {{id: sink, path: sink.py, inputs: {{double: source/number}}{deploy}}}
"""
_LINKS = ("systemctl", "list-units", "--plain", "--no-legend", "doralink-*")
_OURS = r"dora_systemd\.link|^ssh .*-T.*127\.0\.0\.1|^sshd-session: root@notty"
_MEMORY = f"""import glob, os, re
total = 0
for path in glob.glob("/proc/[0-9]*"):
    try:
        words = open(path + "/cmdline").read().replace("\\0", " ")
        if re.search({_OURS!r}, words) and "{HOME}/memory.py" not in words:
            fields = dict(line.split(":") for line in open(path + "/smaps_rollup").readlines()[1:])
            print(int(fields["Rss"].split()[0]), int(fields["Pss"].split()[0]), words[:60])
    except OSError:
        pass
"""


def make_home() -> dict[str, Path]:
    """The files, the same on both machines; the dataflow of each contestant."""
    install = ("pip", "install", "--no-deps", "--no-build-isolation", "--quiet", str(CHECKOUT))
    run(*install)
    assert there(MEMBER, *install).returncode == 0
    project = Project(HOME)
    project.write("source.py", SOURCE)
    project.write("sink.py", SINK)
    project.write("memory.py", _MEMORY)
    files = {
        OURS: project.write("two.yml", _YAML.format(deploy=", deploy: {machine: b}")),
        ONE: project.write("one.yml", _YAML.format(deploy="")),
    }
    subprocess.run(["scp", "-q", "-r", str(HOME), f"root@{MEMBER}:{HOME.parent}"], check=True)
    return files


def seconds_of(*command: str) -> float:
    """How long a command takes."""
    begun = time.monotonic()
    run(*command)
    return time.monotonic() - begun


def start(file: Path) -> float:
    """Start it; the seconds until all nodes are ready."""
    flags = (f"--machine={MEMBER}={MEMBER}",) if file.stem == "two" else ()
    return seconds_of("doractl", "start", str(file), "--name", NAME, *flags)


def start_ms(file: Path) -> float:
    """One start, and a stop behind the clock."""
    seconds = start(file)
    Cell(NAME).end()
    wait_for("the links have ended", lambda: not run(*_LINKS).stdout)
    return seconds * 1000


def login_ms() -> float:
    """A login, and nothing else."""
    return seconds_of("ssh", "-oBatchMode=yes", MEMBER, "true") * 1000


def megabytes(machine: str) -> tuple[float, float]:
    """RSS and PSS of the processes of the link on a machine, without those of this benchmark."""
    command = ("python3", str(HOME / "memory.py"))
    lines = (run(*command) if machine == "a" else there(machine, *command)).stdout.splitlines()
    found = [tuple(map(int, line.split()[:2])) for line in lines]
    return sum(one for one, _ in found) / 1000, sum(one for _, one in found) / 1000


def memory(file: Path) -> list[Figure]:
    """Of a link at both ends, while the dataflow runs."""
    start(file)
    before = len(there(MEMBER, "pgrep", "-f", "sshd-session").stdout.split())
    assert before
    figures = []
    for end, machine, goal in (("head", "a", "≤ 25 MB"), ("member", MEMBER, "≤ 20 MB")):
        rss, pss = megabytes(machine)
        figures.append(Figure(f"memory of a link at the {end}, RSS", "MB", {OURS: [rss]}, goal))
        figures.append(Figure(f"memory of a link at the {end}, PSS", "MB", {OURS: [pss]}))
    Cell(NAME).end()
    return [*map(shown, figures)]


def measure(rounds: int) -> list[Figure]:
    """Starts in turns, then the memory."""
    files = make_home()
    measures: dict[str, Callable[[], float]] = {
        name: partial(start_ms, file) for name, file in files.items()
    }
    measures[LOGIN] = login_ms
    for warm_up in measures.values():
        warm_up()
    what = "start to all of 2 nodes ready, over two machines"
    figure = alternate(what, "ms", measures, rounds, goal="≤ 1.3 × one machine")
    return [figure, *memory(files[OURS])]


if __name__ == "__main__":
    keep("spread", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)

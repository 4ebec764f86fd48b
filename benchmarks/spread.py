"""The same dataflow on one machine and on two.  `LAB=machines`, `python -m benchmarks.spread [N]`

A link is one login by ssh, so that is measured as well: no start over two machines can take less.
Memory and CPU are those of all processes of a link, at both ends.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from benchmarks.flows import CHECKOUT
from benchmarks.rounds import OURS, Figure, alternate, keep, shown
from tests.machines.wires import there
from tests.system.cells import SINK, SOURCE, Cell, Project, run, wait_for

HOME = Path("/srv/bench")
NAME = "spread"
IDLE, BUSY = "idle", "20 messages/s"
MEMBER = "b"
_SECONDS = 60.0
ONE, LOGIN = "one machine", "ssh b true"
_YAML = """nodes:
  - {{id: source, path: source.py, inputs: {{tick: dora/timer/{tick}}}, outputs: [number]}}
  - {{id: sink, path: sink.py, inputs: {{double: source/number}}{deploy}}}
"""
_LINKS = ("systemctl", "list-units", "--plain", "--no-legend", "doralink-*")
_COSTS = """import os
def read(pid, name):
    with open(f"/proc/{pid}/{name}", errors="replace") as file:
        return file.read()
parents, ours = {}, set()
for pid in filter(str.isdecimal, os.listdir("/proc")):
    try:
        parents[pid] = read(pid, "stat").rpartition(")")[2].split()[1]
        if "dora_systemd/link/" in read(pid, "cmdline"):
            ours.add(pid)
    except OSError:
        pass
ssh = {pid for pid, parent in parents.items() if parent in ours}
for pid in [*ours]:
    while (pid := parents.get(pid, "")) and read(pid, "comm").startswith("sshd-session"):
        ssh.add(pid)
for pid in ours | ssh:
    fields = dict(line.split(":") for line in read(pid, "smaps_rollup").splitlines()[1:])
    on_cpu = read(pid, "schedstat").split()[0]
    print(fields["Rss"].split()[0], fields["Pss"].split()[0], on_cpu, read(pid, "comm").strip())
"""
"""Of the programs of a link here, the ssh that is a child of one, and the sshd that is a parent."""


def make_home() -> dict[str, Path]:
    """The files, the same on both machines; the dataflow of each contestant."""
    install = ("pip", "install", "--no-deps", "--no-build-isolation", "--quiet", str(CHECKOUT))
    run(*install)
    assert there(MEMBER, *install).returncode == 0
    project = Project(HOME)
    project.write("source.py", SOURCE)
    project.write("sink.py", SINK)
    project.write("costs.py", _COSTS)
    spread, busy = ", deploy: {machine: b}", "millis/50"
    files = {
        OURS: project.write("two.yml", _YAML.format(deploy=spread, tick=busy)),
        ONE: project.write("one.yml", _YAML.format(deploy="", tick=busy)),
        IDLE: project.write("idle.yml", _YAML.format(deploy=spread, tick="secs/10")),
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
    flags = () if file.stem == "one" else (f"--machine={MEMBER}={MEMBER}",)
    return seconds_of("doractl", "start", str(file), "--name", NAME, *flags)


def start_ms(file: Path) -> float:
    """One start, and a stop behind the clock."""
    seconds = start(file)
    end_cell()
    return seconds * 1000


def end_cell() -> None:
    """Stop it, and wait for its links."""
    Cell(NAME).end()
    wait_for("the links have ended", lambda: not run(*_LINKS).stdout)


def login_ms() -> float:
    """A login, and nothing else."""
    return seconds_of("ssh", "-oBatchMode=yes", MEMBER, "true") * 1000


def costs(machine: str) -> tuple[float, float, float]:
    """Of a link on a machine: RSS and PSS in MB, seconds on a processor."""
    command = ("python3", str(HOME / "costs.py"))
    lines = (run(*command) if machine == "a" else there(machine, *command)).stdout.splitlines()
    print(*lines, sep="\n")
    found = [tuple(map(int, line.split()[:3])) for line in lines]
    assert len(found) > 1, lines
    rss, pss, on_cpu = (sum(column) for column in zip(*found, strict=True))
    return rss / 1000, pss / 1000, on_cpu / 1e9


def share(machine: str) -> float:
    """Percent of a processor that a link takes there."""
    before = costs(machine)[2]
    time.sleep(_SECONDS)
    return 100 * (costs(machine)[2] - before) / _SECONDS


def link_costs(files: Mapping[str, Path]) -> list[Figure]:
    """What a link takes at both ends, while the dataflow runs."""
    figures = []
    for what, file in ((IDLE, files[IDLE]), (BUSY, files[OURS])):
        start(file)
        for end, machine, most in (("head", "a", 25), ("member", MEMBER, 20)):
            link, goal = f"of a link at the {end}", "≤ 0.1 %" if what == IDLE else ""
            if what == IDLE:
                rss, pss, _ = costs(machine)
                figures.append(Figure(f"memory {link}, RSS", "MB", {OURS: [rss]}, f"≤ {most} MB"))
                figures.append(Figure(f"memory {link}, PSS", "MB", {OURS: [pss]}))
            figures.append(Figure(f"CPU {link}, {what}", "%", {OURS: [share(machine)]}, goal))
        end_cell()
    return [*map(shown, figures)]


def measure(rounds: int) -> list[Figure]:
    """Starts in turns, then what the link costs."""
    files = make_home()
    measures: dict[str, Callable[[], float]] = {
        name: partial(start_ms, files[name]) for name in (OURS, ONE)
    }
    measures[LOGIN] = login_ms
    for warm_up in measures.values():
        warm_up()
    what = "start to all of 2 nodes ready, over two machines"
    figure = alternate(what, "ms", measures, rounds, goal="≤ 1.5 × one machine")
    return [figure, *link_costs(files)]


if __name__ == "__main__":
    keep("spread", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)

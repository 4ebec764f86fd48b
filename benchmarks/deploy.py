"""How long a new version interrupts messages, and what ten of 500 MB take on the disk.

`python -m benchmarks.deploy [N]`

The gap is from the last message of the old version to the first of the new one. `doractl restart`
of the same dataflow is the rival, the trial lasts no longer than until all nodes are ready.
"""

import os
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.contestants import NAME
from benchmarks.flows import (
    HOME,
    SINK_YAML,
    SOURCE,
    SOURCE_YAML,
    STAMP,
    STAMPS,
    clear_stamps,
    make_home,
    read_stamps,
    wait_stamps,
)
from benchmarks.rounds import OURS, Figure, alternate, keep, shown, take_turns
from tests.system.cells import Cell, Project, run
from tests.system.releases import Releases

GAP = "from the last message of the old to the first of the new"
COUNT = 10
FILES = 500
MEGABYTE = 1_000_000
SETTLED_SECONDS = 65
"""The age of a file from which on a deploy knows by its times that it has not changed. Nobody
writes a project of 500 MB just before a deploy."""
# One write of a fixed length, so that a stamp is whole whenever its node ends.
SINK = f"""{STAMP}
node = Node()
stamp("ready")
last = os.open("{STAMPS}/last-" + str(os.getpid()), os.O_WRONLY | os.O_CREAT, 0o644)
has_input = False
for event in node:
    if event["type"] == "INPUT":
        os.pwrite(last, b"%020d" % time.monotonic_ns(), 0)
        if not has_input:
            has_input = True
            stamp("input")
"""
SETTINGS = f"writable: [{STAMPS}]\n"


def write_version(project: Project, version: int) -> None:
    """Write a version of the project: all of it, with a source that differs."""
    project.write("source.py", f"{SOURCE}# version {version}\n")
    project.write("sink.py", SINK)
    project.write("dataflow.yml", SOURCE_YAML + SINK_YAML.format(1))
    project.write("dataflow.systemd.yml", SETTINGS)


def deploy(project: Project, *more: str) -> None:
    """Deploy the project, with a trial that ends as soon as all nodes are ready."""
    run("doractl", "deploy", str(project.root), "--name", NAME, "--soak", "0s", *more)


def deploy_next(project: Project, versions: list[int]) -> None:
    """Write one more version and deploy it."""
    versions.append(len(versions))
    write_version(project, versions[-1])
    deploy(project)


def restart() -> None:
    """Restart the release that runs."""
    run("doractl", "restart", NAME)


def gap_ms(act: Callable[[], None]) -> float:
    """From the last message before `act` to the first after it."""
    old = {stamp.pid for stamp in read_stamps()}
    act()
    fresh = [stamp for stamp in wait_stamps("input", 2) if stamp.pid not in old]
    before = max(one.at for one in read_stamps() if one.what == "last" and one.pid in old)
    assert len(fresh) == 1, f"{len(fresh)} sinks had their first message"
    for stamp in [one for one in read_stamps() if one.pid in old]:
        (STAMPS / f"{stamp.what}-{stamp.pid}").unlink()
    return (fresh[0].at - before) * 1000


def measure_gap(project: Project, rounds: int) -> Figure:
    """Deploy and restart in turns, of one dataflow."""
    versions = [0]
    write_version(project, 0)
    clear_stamps()
    deploy(project)
    wait_stamps("input", 1)
    measures = {
        OURS: partial(gap_ms, partial(deploy_next, project, versions)),
        "doractl restart": partial(gap_ms, restart),
    }
    take_turns(measures, 1)  # warm
    return alternate(f"deploy, {GAP}", "ms", measures, rounds, goal="≤ 1.3 × restart")


def used_mb(path: Path) -> float:
    """The disk's blocks of a tree: what has several names counts once."""
    blocks = {one.lstat().st_ino: one.lstat().st_blocks for one in (path, *path.rglob("*"))}
    return sum(blocks.values()) * 512 / MEGABYTE


def seconds(act: Callable[[], object]) -> float:
    """How long it takes."""
    begun = time.monotonic()
    act()
    return time.monotonic() - begun


def measure_large(project: Project, path: Path) -> list[Figure]:
    """A project of 500 MB, a minute old: its first release, and nine with one changed file each."""
    for number in range(FILES):
        project.write(f"data/{number}", "").write_bytes(os.urandom(MEGABYTE))
    keep_all = ("--keep", str(COUNT))
    time.sleep(SETTLED_SECONDS)
    deploy(project, *keep_all)
    one = used_mb(path / Releases(Cell(NAME)).current())
    took: dict[str, list[float]] = {OURS: [], "cp -r": []}
    for number in range(1, COUNT):
        project.write(f"data/{number}", "").write_bytes(os.urandom(MEGABYTE))
        took[OURS].append(seconds(partial(deploy, project, *keep_all)))
        copy = HOME / "copy"
        took["cp -r"].append(seconds(partial(run, "cp", "-r", str(project.root), str(copy))))
        shutil.rmtree(copy)
    disk = {OURS: [used_mb(path)], "one release": [one]}
    return [
        shown(Figure("disk of ten releases of 500 MB, 1 MB changed in each", "MB", disk, "≤ 1.1")),
        shown(Figure("deploy of 500 MB, 1 MB changed, as a whole", "s", took, "≤ 1.2 s")),
    ]


def measure(rounds: int) -> list[Figure]:
    """The gap of a small project; disk and time of a large one."""
    make_home()
    project = Project(HOME / "robot")
    releases = Releases(Cell(NAME))
    try:
        return [measure_gap(project, rounds), *measure_large(project, releases.path)]
    finally:
        releases.end()


if __name__ == "__main__":
    keep("deploy", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)

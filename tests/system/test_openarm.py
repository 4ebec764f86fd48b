"""A real stack: nodes of OpenArm as PyPI has them record a dataset, beside bare dora."""

import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.lab.pace import bound, pace
from tests.system.cells import Cell, Project, run, wait_for, wait_no_process
from tests.system.complaints import complaints, end_of_journal
from tests.system.openarm import (
    CAMERAS,
    STATE,
    STREAMS,
    UV,
    Episode,
    Recorder,
    bare_dora,
    write_project,
)
from tests.system.releases import Releases

pytestmark = [pytest.mark.lab, pytest.mark.openarm]

NODES = (
    *("ui", "tick-arms", "tick-cameras", "leader", "follower-right", "follower-left"),
    *(f"camera-{name.replace('_', '-')}" for name in CAMERAS),
    "recorder",
)
FRAMES = int(os.environ.get("FRAMES", "100"))
"""Of each camera in an episode that is compared, 20 a second."""
NEAR = 0.03
"""Of an idle machine. Cameras that wait for the processor miss frames by chance."""
TRIES = 3
CACHE = ("--property", "CacheDirectory=openarm", "--env", "UV_CACHE_DIR=/var/cache/openarm")
ENV = [word for name, value in UV.items() for word in ("--env", f"{name}={value}")]
KILLS = ("crashed: signal SIGKILL", "is being restarted", "exited with error: Signal(9)")


@pytest.fixture(scope="module")
def flow() -> Iterator[Path]:
    root = Path(tempfile.mkdtemp(prefix="openarm-", dir="/var/tmp"))
    root.chmod(0o755)
    yield write_project(Project(root / "openarm"))
    shutil.rmtree(root)


def test_uv(cell: Cell, flow: Path) -> None:
    """The page ends the dataflow, and the recorder the episode that is open."""
    cell.start(flow, "--uv", *CACHE, *ENV, "--env", "DATASET=uv")
    assert cell.status.nodes["leader"].kind == "uv"
    ours = Recorder(STATE / "uv")
    ours.warm_up()
    ours.begin(10)
    first = ours.end()
    last = ours.begin(10)
    ours.post("quit")
    wait_for("it has ended", lambda: cell.is_gone)
    assert cell.show("Result") == "success"
    assert ours.listed() == [first, last]
    for number in (first, last):
        assert min(len(times) for times in ours.read(number).times.values()) >= 10


@pytest.mark.warns("SIGKILL", "status=9/KILL", "Failed with result", "Scheduled restart job")
def test_deployed_and_killed_in_the_middle_of_a_recording(
    releases: Releases, flow: Path, project: Project
) -> None:
    """Two releases, which share the virtual environment; then all processes are killed."""
    for name in ("dataflow.yml", "dataflow.systemd.yml", "metadata.yaml", "leader.py"):
        project.write(name, flow.with_name(name).read_text())
    words = ("--soak", "1s", "--venv", str(flow.with_name(".venv")))
    releases.deploy(project.root, *words, "--env", "DATASET=first")
    ours = Recorder(STATE / "first")
    ours.warm_up()
    ours.begin(10)
    number = ours.end()
    whole = ours.read(number)
    dropped = ours.begin(10)
    project.write("leader.py", flow.with_name("leader.py").read_text() + "# another release\n")
    releases.deploy(project.root, *words, "--env", "DATASET=second")
    assert ours.listed() == [number]
    assert ours.read(number) == whole
    assert ours.is_open(dropped)
    next_one = Recorder(STATE / "second")
    next_one.warm_up()
    next_one.begin(10)
    last = next_one.read(number := next_one.end())
    next_one.begin(10)
    releases.cell.systemctl("kill", "--signal=KILL")
    assert next_one.read(number) == last


@pytest.fixture(scope="module")
def running(flow: Path) -> Iterator[Cell]:
    """The dataflow, started with the .venv beside it."""
    cell, cursor = Cell("openarm"), end_of_journal()
    cell.start(flow, "--env", "DATASET=venv")
    yield cell
    cell.end()
    wait_no_process()
    assert complaints(cursor, KILLS) == []


@pytest.fixture(scope="module")
def ours(running: Cell) -> Recorder:
    """Its page and dataset, when all nodes exchange something."""
    del running
    recorder = Recorder(STATE / "venv")
    recorder.warm_up()
    return recorder


def test_as_much_as_with_bare_dora(ours: Recorder, flow: Path) -> None:
    """Both at the same time, so that both have the same machine; it may be too busy at times."""
    state = Path(tempfile.mkdtemp(prefix="bare-", dir="/var/tmp"))
    with bare_dora(flow, state) as (bare, dora):
        bare.warm_up()
        assert any(are_alike(*record(ours, bare)) for _ in range(TRIES))
        # The recorder drops an episode that nobody has ended.
        listed, dropped = bare.listed(), bare.begin(10)
        dora.send_signal(signal.SIGINT)
        dora.wait(bound(60))
        assert bare.listed() == listed
        assert bare.is_open(dropped)


def record(*recorders: Recorder) -> list[Episode]:
    """The same episode of each."""
    for one in recorders:
        one.post("start")
    for one in recorders:
        one.wait_frames(one.number(), FRAMES)
    numbers = [one.number() for one in recorders]
    for one in recorders:
        one.post("success")
    for one, number in zip(recorders, numbers, strict=True):
        one.wait_listed(number)
    return [one.read(number) for one, number in zip(recorders, numbers, strict=True)]


def are_alike(ours: Episode, bare: Episode) -> bool:
    """Whether there are as many rows and frames, as often, and as few lost, within NEAR."""
    pairs = (ours.counts(), bare.counts()), (ours.rates(), bare.rates())
    for name in ours.times:
        print(f"{name:12}", *(f"{one[name]:.2f}" for pair in pairs for one in pair))
    print("lost", ours.lost(), bare.lost())
    near = min(NEAR * pace(), 0.5)
    most = near * ours.counts()[STREAMS[0]]
    return all(a == pytest.approx(b, rel=near) for a, b in pairs) and all(
        count <= most for count in ours.lost().values()
    )


def test_each_node_is_killed_once(running: Cell, ours: Recorder) -> None:
    """All but two in the middle of an episode, which has what came before and after each gap."""
    number = ours.begin(1)
    for node in (one for one in NODES if one not in ("ui", "recorder")):
        before = {one: len(ours.frames(number, one)) for one in CAMERAS}
        kill(running, node)
        wait_for("frames of each camera", lambda: has_more(ours, number, before))  # noqa: B023
    assert ours.end() == number
    whole = ours.read(number)
    kill(running, "recorder")
    another = ours.begin(10)
    assert ours.end() == another
    assert ours.read(number) == whole
    listed = ours.listed()
    kill(running, "ui")
    ours.wait_page()
    # The page counts from 0 again, which was cancelled.
    assert (ours.listed(), ours.number()) == (listed, 0)
    assert {node: one.restarts for node, one in running.status.nodes.items()} == dict.fromkeys(
        NODES, 1
    )


def has_more(recorder: Recorder, number: int, before: Mapping[str, int]) -> bool:
    """Whether each camera has more frames in the episode than before."""
    return all(len(recorder.frames(number, one)) > count for one, count in before.items())


def kill(cell: Cell, node: str) -> None:
    """kill -9 of a node; return when dora has started it again."""
    before = cell.status.nodes[node]
    run("kill", "-KILL", str(before.pid))
    begun = time.monotonic()

    def is_back() -> bool:
        now = cell.status.nodes[node]
        return now.pid != before.pid and now.state == "running" and bool(now.pid)

    wait_for(f"{node} runs again", is_back)
    print(f"{node}: {time.monotonic() - begun:.2f} s")


def test_stopped_in_the_middle_of_a_recording(running: Cell, ours: Recorder) -> None:
    """It leaves what bare dora leaves: all but the episode that is open."""
    listed = ours.listed()
    whole = [ours.read(one) for one in listed]
    number = ours.begin(10)
    stop(running)
    assert ours.listed() == listed
    assert ours.is_open(number)
    assert [ours.read(one) for one in listed] == whole


def test_stopped_right_after_the_end_of_a_recording(
    running: Cell, ours: Recorder, flow: Path
) -> None:
    """The recorder stops last, so the word of the page comes before the stop."""
    stop(running)
    running.start(flow, "--env", "DATASET=again")
    again = Recorder(STATE / "again", ours.port)
    again.warm_up()
    number = again.begin(10)
    again.post("success")
    stop(running)
    assert again.listed() == [number]
    assert min(len(times) for times in again.read(number).times.values()) >= 10


def stop(cell: Cell) -> None:
    """`doractl stop`, if it runs."""
    begun = time.monotonic()
    cell.doractl("stop", cell.name, check=False)
    print(f"stop: {time.monotonic() - begun:.2f} s")
    assert cell.is_gone


DOWN = """[Unit]
Requires=basic.target
Wants=lab-command.service systemd-journald.service dbus.service
AllowIsolate=yes
"""


def test_shut_down_right_after_the_end_of_a_recording(
    running: Cell, ours: Recorder, flow: Path
) -> None:
    """A container cannot reboot: all services stop as at a shutdown, and start as at a boot."""
    stop(running)
    running.start(flow, "--enable", "--env", "DATASET=boot")
    boot = Recorder(STATE / "boot", ours.port)
    boot.warm_up()
    number = boot.begin(10)
    boot.post("success")
    target = Path("/run/systemd/system/lab-down.target")
    try:
        target.write_text(DOWN)
        run("systemctl", "daemon-reload")
        run("systemctl", "isolate", target.name)
        wait_for("it has stopped", lambda: running.show("ActiveState") == "inactive", 60)
        assert boot.listed() == [number]
        whole = boot.read(number)
        assert min(len(times) for times in whole.times.values()) >= 10
        run("systemctl", "start", "multi-user.target")
        wait_for("it runs", lambda: running.show("ActiveState") == "active", 60)
        boot.wait_page()
        # The page counts from 0 again, and the recorder refuses an episode that is there already.
        assert (boot.listed(), boot.number()) == ([number], 0)
        assert boot.read(number) == whole
    finally:
        target.unlink()
        running.doractl("disable", running.name)

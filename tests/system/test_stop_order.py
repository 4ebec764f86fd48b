"""Nodes that stop in an order, each in its own time: a recorder loses nothing, others end as usual.

dora would kill the recorder in the middle of its work: that takes two grace durations.
"""

import re
import signal
import subprocess
import time

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, sync_journal, wait_for
from tests.system.recorders import (
    CRASHES,
    check_saved,
    ends,
    episodes,
    flow,
    parts,
    saved,
    start,
)


@pytest.mark.lab
def test_the_recorder_is_told_last_and_has_its_time(cell: Cell, project: Project) -> None:
    start(cell, flow(project))
    assert cell.show("TimeoutStopUSec") == "5min 10s"
    begun = time.monotonic_ns()
    done = cell.doractl("stop", cell.name)
    assert "killed" not in done.stdout
    check_saved(cell, project, 1)
    last = max(ends(cell, node)[0][0] for node in ("camera", "arm"))
    assert last - begun < bound(3) * 1e9, "the others end as fast as ever"


@pytest.mark.lab
@pytest.mark.warns("failed to receive reply from daemon", "Signal(15)")
def test_a_node_that_waits_or_was_stopped_holds_nobody(cell: Cell, project: Project) -> None:
    dataflow, device = flow(project), project.write("device", "")
    settings = project.root / "flow.systemd.yml"
    project.write("flow.systemd.yml", f"{settings.read_text()}  camera: {{needs: {device}}}\n")
    start(cell, dataflow)
    device.unlink()
    wait_for("it waits", lambda: cell.status.nodes["camera"].state == "waiting")
    cell.doractl("node", "stop", cell.name, "arm")
    cell.doractl("stop", cell.name)
    assert len(episodes(project)) == 1


@pytest.mark.lab
def test_more_time_as_long_as_the_node_asks_for_it(cell: Cell, project: Project) -> None:
    dataflow = flow(project, "{within: 1s, after: [camera, arm]}")
    project.write("extend", "")
    start(cell, dataflow)
    cell.doractl("stop", cell.name)
    assert len(episodes(project)) == 1


@pytest.mark.lab
@pytest.mark.warns(*CRASHES, "has not stopped in its time")
def test_a_node_that_does_not_ask_is_ended_in_its_time(cell: Cell, project: Project) -> None:
    start(cell, flow(project, "1s", seconds=60))
    begun = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - begun < bound(5)
    assert parts(project), "SIGTERM came after a second"
    sync_journal()
    why = cell.doractl("why", cell.name).stdout
    assert re.search("; not stopped in their time: .*recorder", why)


@pytest.mark.lab
@pytest.mark.warns(*CRASHES, "was killed (SIGKILL)", "status=9/KILL", "Failed with result")
@pytest.mark.parametrize("how", ["now", "interrupt"])
def test_who_cannot_wait(cell: Cell, project: Project, how: str) -> None:
    start(cell, flow(project, seconds=60))
    command = ["doractl", cell.scope.flag, "stop", cell.name]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as first:
        wait_for("it writes", lambda: parts(project))
        begun = time.monotonic()
        if how == "now":
            cell.doractl("stop", "--now", cell.name)
        else:
            first.send_signal(signal.SIGINT)
            assert first.stderr is not None
            assert "Ctrl+C again" in first.stderr.readline()
            assert parts(project), "the first one only says so"
            first.send_signal(signal.SIGINT)
        first.wait(bound(30))
    assert time.monotonic() - begun < bound(10)
    wait_for("it is gone", lambda: cell.is_gone)
    assert parts(project)


@pytest.mark.lab
def test_what_it_waits_for_is_shown(cell: Cell, project: Project) -> None:
    start(cell, flow(project))
    hold = saved(project) / "hold"
    hold.touch()
    with subprocess.Popen(["doractl", cell.scope.flag, "stop", cell.name]) as first:
        wait_for("it writes", lambda: parts(project))
        shown = wait_for("its status", lambda: _list_with(cell, "writing"))
        assert "Stopping (recorder: writing episode, " in shown
        assert "s left)" in shown
        hold.unlink()
        first.wait(bound(40))


def _list_with(cell: Cell, word: str) -> str:
    shown = cell.doractl("list", cell.name).stdout
    return shown if word in shown else ""


REFUSED = [
    ("{after: [camra]}", "cannot stop recorder after the node 'camra': no such node"),
    ("{after: [recorder]}", "cannot stop recorder after recorder: that is a circle"),
    ("{within: 10min}", "cannot give the node recorder 10min to stop: "),
    ("{within: 5}", "cannot read the stop of a node: within is '5'"),
]


@pytest.mark.parametrize(("stop", "words"), REFUSED, ids=["name", "circle", "limit", "unit"])
def test_what_cannot_be_is_refused_before_anything_starts(
    cell: Cell, project: Project, stop: str, words: str
) -> None:
    done = cell.start(flow(project, stop), check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert words in done.stderr
    assert "hint: " in done.stderr
    sync_journal()
    assert not cell.journal()

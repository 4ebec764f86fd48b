"""doractl stop, restart, node, show and dora against real dataflows."""

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import SINK, Cell, Project, is_alive, run, sync_journal, wait_for

DEAF = """
import os, signal, time
from dora import Node
node = Node()
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if os.fork() == 0 and os.fork() == 0:
    os.setsid()
print("deaf", flush=True)
while True:
    time.sleep(1)
"""


def test_stop(cell: Cell, project: Project) -> None:
    started = json.loads(cell.start(project.three_nodes(), "-o", "json").stdout)
    pids = cell.all_pids()
    done = cell.doractl("stop", cell.name)
    assert done.stdout == f"Dataflow stopped: {started['uuid']} ({cell.name})\n"
    assert not [pid for pid in pids if is_alive(pid)]
    again = cell.doractl("stop", cell.name)
    assert again.stdout == f"Dataflow not running: {started['uuid']} ({cell.name} stopped)\n"


@pytest.mark.lab
def test_what_is_frozen_is_shown_and_thawed_first(cell: Cell, project: Project) -> None:
    """A kill of a frozen unit can hang systemd, and systemd refuses to stop it."""
    cell.start(project.three_nodes())
    for verb in ("restart", "stop"):
        cell.systemctl("freeze")
        assert "Status:   Frozen" in cell.doractl("list", cell.name).stdout
        why = cell.doractl("why", cell.name).stdout
        assert f"run: systemctl {cell.scope.flag} thaw {cell.unit}" in why
        done = cell.doractl(verb, cell.name)
        assert "thawed first, it was frozen" in done.stdout
    assert cell.is_gone


def test_stop_what_is_not_there() -> None:
    done = run("doractl", "stop", "nothing-of-that-name", check=False)
    assert done.returncode == ExitCode.NOT_FOUND
    assert done.stderr.startswith("doractl: no dataflow named 'nothing-of-that-name'\nhint: ")


def test_stop_all(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    others = [Cell(f"{cell.name}-{n}") for n in (1, 2)]
    for one in (cell, *others):
        one.start(flow)
    done = cell.doractl("stop", f"{cell.name}-*")
    assert done.stdout.count("Dataflow stopped: ") == 2
    done = cell.doractl("stop", "--all")
    assert done.stdout.count("Dataflow stopped: ") == 1
    assert all(one.is_gone for one in (cell, *others))
    assert cell.doractl("stop", "--all").stdout == "No dataflow is running.\n"


@pytest.mark.lab
@pytest.mark.warns("was killed (SIGKILL)", "status=9/KILL", "Failed with result")
def test_an_interrupted_stop_continues(cell: Cell, project: Project) -> None:
    project.write("deaf.py", DEAF)
    tick = "inputs: {tick: dora/timer/millis/50}"
    cell.start(project.write("dataflow.yml", f"nodes: [{{id: one, path: deaf.py, {tick}}}]"))
    wait_for("it is deaf", lambda: "deaf" in cell.messages("one"))
    command = ["doractl", cell.scope.flag, "stop", cell.name]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as first:
        wait_for("it stops", lambda: cell.show("ActiveState") == "deactivating")
        first.send_signal(signal.SIGINT)
        assert first.stderr is not None
        said = first.stderr.readline()
    assert said == f"doractl: interrupted; the stop of {cell.name} continues\n"
    assert first.returncode == ExitCode.INTERRUPTED
    done = cell.doractl("start", cell.name, check=False)
    assert done.returncode == ExitCode.NAME_IN_USE
    assert done.stderr.startswith(f"doractl: cannot start {cell.name}: it is stopping\n")
    assert cell.doractl("stop", "--now", cell.name).stdout.endswith(": killed\n")
    # It ended as it was told to, so this is no failure.
    who = r"stopped by \S+ [(]doractl stop[)]; killed"
    why = cell.doractl("why", cell.name).stdout
    assert re.search(rf"Stopped\n +Why: +{who}\n", why), why
    row = next(one for one in _rows(cell) if one["name"] == cell.name)
    assert (row["status"], bool(re.fullmatch(who, row["text"]))) == ("Stopped", True), row


def _rows(cell: Cell) -> list[dict[str, Any]]:
    sync_journal()
    rows: list[dict[str, Any]] = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    return rows


@pytest.mark.warns("not stopping within the 1.5s", "process was killed on drop", "Signal(9)")
def test_stop_ends_in_time_whatever_the_nodes_do(cell: Cell, project: Project) -> None:
    project.write("deaf.py", DEAF)
    tick = "inputs: {tick: dora/timer/millis/50}"
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: deaf.py, {tick}}}]")
    cell.start(flow, "--grace-duration", "1s")
    wait_for("it is deaf", lambda: "deaf" in cell.messages("one"))
    pids = cell.all_pids()
    begin = time.monotonic()
    done = cell.doractl("stop", cell.name)
    assert time.monotonic() - begin < bound(1.5 + 10)
    assert not [pid for pid in pids if is_alive(pid)]
    assert "killed after 1s 500ms: one" in done.stdout
    sync_journal()
    assert "; killed after the grace duration: one\n" in cell.doractl("why", cell.name).stdout


def test_restart_keeps_name_and_uuid(cell: Cell, project: Project) -> None:
    started = json.loads(cell.start(project.three_nodes(), "-o", "json").stdout)
    pids = cell.all_pids()
    done = cell.doractl("restart", cell.name)
    assert done.stdout == f"Dataflow restarted: {started['uuid']} ({cell.name})\n"
    assert not [pid for pid in pids if is_alive(pid)]
    assert started["uuid"] in cell.show("ExecStart")
    cell.wait_exchanging()
    sync_journal()
    assert "(doractl restart) (" in cell.doractl("why", cell.name).stdout, "with its time"


@pytest.mark.warns("failed to receive reply from daemon", "Signal(15)")
def test_restart_of_one_node(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    before = {node: status.pid for node, status in cell.status.nodes.items()}
    cell.doractl("node", "restart", cell.name, "doubler")
    wait_for("it is replaced", lambda: cell.status.nodes["doubler"].pid != before["doubler"])
    wait_for("the old one has gone", lambda: not is_alive(before["doubler"]))
    after = cell.status.nodes
    assert [after[node].pid for node in ("source", "sink")] == [before["source"], before["sink"]]
    cell.wait_exchanging()


@pytest.mark.warns(
    *("Node sink crashed: signal SIGKILL", "Node sink is being restarted by dora"),
    *("error: Signal(9) node_id=sink", "error: ExitCode(3) node_id=sink"),
)
def test_restarts_and_stops_that_somebody_asks_for(cell: Cell, project: Project) -> None:
    """They count nowhere, however the node ends; one that crashes has all of its restarts."""
    flow = project.three_nodes()
    policy = "    restart_policy: on-failure\n    max_restarts: 2\n"
    flow.write_text(flow.read_text() + policy)
    project.write("sink.py", SINK + "raise SystemExit(3)\n")
    cell.start(flow)
    pids = {cell.status.nodes["sink"].pid}
    for _ in range(4):
        cell.doractl("node", "restart", cell.name, "sink")
        wait_for("it runs", lambda: cell.status.nodes["sink"].state == "running")
        pids.add(cell.status.nodes["sink"].pid)
    assert len(pids) == 5
    assert cell.status.nodes["sink"].restarts == 0
    os.kill(cell.status.nodes["sink"].pid, signal.SIGKILL)
    wait_for("dora restarts it", lambda: cell.status.nodes["sink"].restarts == 1)
    wait_for("it runs", lambda: cell.status.nodes["sink"].state == "running")
    for said in ("stopping: sink", "already stopped: sink (requested by "):
        assert f"Node {said}" in cell.doractl("node", "stop", cell.name, "sink").stdout
    wait_for("it has gone", lambda: not cell.pids("node-sink"))
    assert cell.show("ActiveState") == "active"
    sync_journal()
    shown = cell.doractl("list", cell.name).stdout, cell.doractl("why", cell.name).stdout
    for text in shown:
        assert re.search(r"Stopped: +sink, requested by .* [(]doractl node stop[)]", text), text
    assert re.search(r"^sink +Stopped +-", shown[0], re.M)
    assert shown[1].startswith(f"{cell.name}: Running\n")
    cell.doractl("node", "restart", cell.name, "sink")
    cell.wait_exchanging()
    events = [name for name, node in cell.events() if node == "sink"]
    counts = {"node-asked": 6, "node-crashed": 1, "node-restarted": 1, "node-exited": 5}
    assert {name: events.count(name) for name in counts} == counts


@pytest.mark.warns("failed to receive reply from daemon")
def test_a_stopped_node_that_others_read_comes_back_to_them(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    cell.doractl("node", "stop", cell.name, "doubler")
    wait_for("its launcher waits", lambda: cell.status.nodes["doubler"].is_held)
    assert cell.status.nodes["sink"].state == "running"
    cell.doractl("node", "restart", cell.name, "doubler")
    cell.wait_exchanging()
    cell.doractl("node", "stop", cell.name, "doubler")
    wait_for("its launcher waits", lambda: cell.status.nodes["doubler"].is_held)
    begin = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - begin < bound(8)


def test_stock_dora(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--debug")
    shown = cell.doractl("dora", cell.name, "--", "node", "list").stdout
    assert "doubler" in shown
    topic = ("dora", cell.name, "--", "topic", "echo", "--count", "1", "source/number")
    done = cell.doractl(*topic, check=False)
    assert done.returncode == 0, done.stderr
    assert "number" in done.stdout


# A node that knows no dora ends of SIGTERM, and the daemon says so if it is still there.
@pytest.mark.warns("failed to receive reply from daemon", "Signal(15)")
def test_verbs_that_need_a_running_dataflow(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", "nodes: [{id: never, path: sleep, args: '100'}]")
    cell.start(flow, "--no-wait")
    cell.doractl("stop", cell.name)
    for words in (["show", cell.name], ["dora", cell.name, "--", "list"]):
        assert cell.doractl(*words, check=False).returncode == ExitCode.NOT_RUNNING


class TestWhatRuns:
    """All of them look at the same dataflow."""

    def test_unknown_node(self, running: Cell) -> None:
        done = running.doractl("node", "stop", running.name, "sinc", check=False)
        assert done.returncode == ExitCode.NOT_FOUND
        assert "did you mean sink" in done.stderr

    @pytest.mark.lab
    def test_others_cannot_speak_to_the_coordinator(self, running: Cell) -> None:
        for words in ("node stop NAME sink", "dora NAME -- node list"):
            command = f"exec doractl --system {words.replace('NAME', running.name)}"
            done = run("su", "bob", "-s", "/bin/sh", "-c", command, check=False)
            assert done.returncode == ExitCode.NO_PERMISSION, done.stderr
            assert len(done.stderr.splitlines()) == 2
        assert len(running.pids("node-sink")) == 1

    @pytest.mark.lab
    def test_others_cannot_stop_it(self, running: Cell) -> None:
        command = f"exec doractl --system stop {running.name}"
        done = run("su", "bob", "-s", "/bin/sh", "-c", command, check=False)
        assert done.returncode == ExitCode.NO_PERMISSION
        assert "sudo" in done.stderr
        assert running.show("ActiveState") == "active"

    def test_show_is_what_systemctl_cat_prints(self, running: Cell) -> None:
        shown = running.doractl("show", running.name).stdout
        assert shown.strip() == running.systemctl("cat", "--no-pager").strip()
        files = json.loads(running.doractl("show", running.name, "-o", "json").stdout)["files"]
        assert [Path(path).name for path in files] == [running.unit]

"""Restart policies with real dora and systemd: one owner for each failure, and a visible budget."""

import json
import os
import signal
import time

import pytest

from dora_systemd.adapters.host.clients import process_start
from dora_systemd.decisions.cell.restarts import HEAD_START
from dora_systemd.errors import ExitCode
from dora_systemd.values import SECOND, format_duration
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, is_alive, run, wait_for

CRASHING = """
import sys
from dora import Node
node = Node()
for event in node:
    if event["type"] == "INPUT":
        print("I crash", flush=True)
        sys.exit(3)
"""
CRASH = "nodes: [{id: bad, path: bad.py, inputs: {tick: dora/timer/millis/50}}]"
FINISHING = "from dora import Node\nnode = Node()\nprint('done', flush=True)\n"
LATE = "import time\ntime.sleep(1000)\n"
HANGING = """
import time
from dora import Node
node = Node()
for event in node:
    print("I hang", flush=True)
    time.sleep(1000)
"""
ON_FAILURE = ("--restart-policy", "on-failure")
CRASHES = ("crashed", "exit code 3", "ExitCode(3)", "restarted", "after failure", "Failed with")
KILLED = (
    *("code=killed", "Failed with result", "status=69", "is lost", "failed: ", "was killed ("),
    *("disconnected", "start-limit", "too quickly", "exited", "Failed to start"),
)


def listed(cell: Cell) -> dict[str, object]:
    row: dict[str, object] = json.loads(cell.doractl("list", cell.name, "-o", "json",
                                                     check=False).stdout)  # fmt: skip
    return row


def kill(cell: Cell, what: str) -> int:
    pid = cell.supervisor_pid(what)
    os.kill(pid, signal.SIGKILL)
    wait_for("it is dead", lambda: not is_alive(pid))
    return pid


@pytest.mark.warns(*CRASHES)
def test_three_restarts_are_three(cell: Cell, project: Project) -> None:
    """The crashes of a node are dora's alone: systemd does not begin again after the last one."""
    project.write("bad.py", CRASHING)
    words = ("--max-restarts", "3", "--max-restart-delay", "500ms")
    cell.start(project.write("flow.yml", CRASH), *ON_FAILURE, *words)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    assert cell.messages("bad").count("I crash") == 4
    assert [event for event, _ in cell.events()].count("node-restarted") == 3
    assert (cell.show("NRestarts"), cell.show("ExecMainStatus")) == ("0", "70")
    assert "node bad: exit code 3 after 3 restarts" in cell.show("StatusText")


@pytest.mark.warns(*CRASHES, *KILLED)
def test_a_restart_at_once_ends_as_well(cell: Cell, project: Project) -> None:
    """Of a node by dora, and of the dataflow by systemd: the budget is what ends a crash loop."""
    project.write("bad.py", CRASHING)
    words = (*ON_FAILURE, "--restart-delay", "0")
    flow = project.write("flow.yml", CRASH)
    refused = cell.start(flow, *words, "--max-restarts", "infinity", check=False)
    assert "cannot use restart_delay 0" in refused.stderr
    cell.start(flow, *words, "--max-restarts", "3", "--max-restart-delay", "0", "--no-wait")
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    restarted, ready = times(cell, "node-restarted"), times(cell, "node-ready")[1:]
    delays = [ready - crash for crash, ready in zip(restarted, ready, strict=True)]
    assert (len(delays), min(delays) < bound(0.5) * SECOND) == (3, True)

    cell.start(project.three_nodes(), *words, "--max-restarts", "2")
    assert cell.show("RestartUSec") == "0"

    def come_back(restarts: str) -> None:
        kill(cell, "runner")
        wait_for("it is restarted", lambda: cell.show("NRestarts") == restarts)
        wait_for("it is up", lambda: cell.show("ActiveState") == "active")

    come_back("1")
    come_back("2")
    kill(cell, "runner")
    wait_for("it is given up", lambda: cell.show("ActiveState") == "failed")
    assert cell.show("ExecMainStatus") == "75"


@pytest.mark.warns(*CRASHES)
def test_what_the_dataflow_says_of_a_node_holds(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("bad.py", CRASHING)
    bad = "\n  - {id: bad, path: bad.py, restart_policy: never, inputs: {n: source/number}}\n"
    flow.write_text(flow.read_text().rstrip() + bad)
    project.write("dataflow.systemd.yml", "nodes: {sink: {max_restarts: 7}}")
    cell.start(flow, *ON_FAILURE, check=False)
    wait_for("it is degraded", lambda: cell.status.stage == "degraded")
    assert cell.status.nodes["bad"].restarts == 0
    nodes = {one["node"]: one for one in listed(cell)["nodes"]}  # type: ignore[attr-defined]
    assert nodes["sink"]["max_restarts"] == 7
    assert nodes["source"]["max_restarts"] == 5
    assert nodes["bad"]["max_restarts"] is None
    assert "0/7" in cell.doractl("list", cell.name).stdout


def used_budget(cell: Cell) -> dict[str, int]:
    budget = listed(cell)["restart_budget"]
    assert isinstance(budget, dict)
    return budget if budget["used"] else {}


@pytest.mark.warns(*KILLED)
def test_starts_by_hand_use_up_no_restart(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), *ON_FAILURE, "--max-restarts", "1", "--no-wait")
    for _ in range(8):
        cell.systemctl("restart")
    assert cell.show("ActiveState") == "active"
    assert not used_budget(cell)
    kill(cell, "runner")
    wait_for("it is restarted", lambda: cell.show("NRestarts") == "1")
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    kill(cell, "runner")
    wait_for("it is given up", lambda: cell.show("ActiveState") == "failed")
    assert cell.show("ExecMainStatus") == "75"
    assert (cell.show("NRestarts"), listed(cell)["restarts"]) == ("2", 1), "one was refused"
    words = cell.doractl("why", cell.name, check=False).stdout
    assert "Why:      the supervisor process was killed (SIGKILL)" in words
    assert "Restarts: dataflow 1 (the supervisor process was killed (SIGKILL))" in words
    assert "systemd has stopped restarting it" in words
    cell.systemctl("start")
    assert (cell.show("ActiveState"), cell.show("NRestarts")) == ("active", "0")


@pytest.mark.warns(*KILLED)
def test_the_budget_is_seen_used_up_and_reset(cell: Cell, project: Project) -> None:
    words = ("--max-restarts", "1", "--restart-window", "5min")
    cell.start(project.three_nodes(), *ON_FAILURE, *words)
    assert listed(cell)["restart_budget"] == {
        "used": 0,
        "max": 1,
        "next_us": None,
        "resets_us": None,
    }
    old = kill(cell, "daemon")
    wait_for("it is back", lambda: cell.show("ActiveState") == "active" and not is_alive(old))
    cell.wait_exchanging()
    # Which starts there were is in the journal, which a busy machine writes a moment later.
    budget = wait_for("it is counted", lambda: used_budget(cell))
    assert (budget["used"], budget["max"]) == (1, 1)
    assert 0 < budget["resets_us"] <= 300 * SECOND
    spent = "Budget:   1/1 restarts of the dataflow used, resets in "
    assert spent in cell.doractl("list", cell.name).stdout

    done = cell.doractl("reset", cell.name)
    assert done.stdout.endswith(f"({cell.name}, restart counter reset, was 1)\n")
    assert cell.show("ActiveState") == "active"
    kill(cell, "runner")
    wait_for("it is back", lambda: cell.show("NRestarts") == "1")
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    kill(cell, "runner")
    wait_for("it is given up", lambda: cell.show("ActiveState") == "failed")
    assert listed(cell)["status"] == "Failed"

    # Who restarts it by hand begins anew.
    assert cell.doractl("restart", cell.name).returncode == 0
    assert cell.show("NRestarts") == "0"


@pytest.mark.warns(*KILLED)
def test_the_delay_grows_and_begins_anew_after_a_quiet_window(cell: Cell, project: Project) -> None:
    words = ("--restart-policy", "always", "--max-restarts", "1000", "--restart-window", "20s")
    cell.start(project.three_nodes(), *words, "--restart-delay", "1s")

    def lose() -> bool:
        """Kill the runner, which the daemon would take its time to do; whether the next waits."""
        texts = []
        kill(cell, "runner")
        wait_for("it is away", lambda: cell.show("ActiveState") != "active")
        while cell.show("ActiveState") != "active":
            texts.append(cell.show("StatusText"))
        return any("restarting in" in text for text in texts)

    assert not lose()
    assert lose()
    kill(cell, "runner")
    wait_for("its runner waits", lambda: "restarting in" in cell.show("StatusText"))
    row = listed(cell)
    budget = row["restart_budget"]
    assert isinstance(budget, dict)
    most = 3 * SECOND + HEAD_START
    assert (row["status"], 0 < budget["next_us"] <= most) == ("Restarting", True)
    assert "Restarting" in cell.doractl("why", cell.name, check=False).stdout
    wait_for("it is back", lambda: cell.show("ActiveState") == "active", 30)
    store = ("systemd-analyze", cell.scope.flag, "fdstore", cell.unit)
    wait_for("the window is quiet", lambda: run(*store).stdout.count("\ndora-life ") == 1)
    assert not lose()
    # Who restarts it by hand does not wait.
    cell.systemctl("restart")
    assert cell.show("NRestarts") == "0"


def times(cell: Cell, event: str) -> list[int]:
    """When journald got the life events of that name, in µs."""
    return [int(one["__REALTIME_TIMESTAMP"]) for one in cell.journal(f"DORA_EVENT={event}")]


@pytest.mark.warns(*KILLED)
def test_no_node_starts_before_the_delay_is_over(cell: Cell, project: Project) -> None:
    """The runner starts before that, but not after a restart by hand, which has no delay."""
    cell.start(project.three_nodes(), "--restart-policy", "always", "--restart-delay", "1s")
    assert cell.show("RestartUSec") == "600ms"
    began = time.clock_gettime(time.CLOCK_BOOTTIME)
    kill(cell, "runner")
    wait_for("it begins again", lambda: len(times(cell, "dataflow-started")) == 2)
    (node,) = cell.pids("node-source")
    assert process_start(node) - began >= 1 - 1 / os.sysconf("SC_CLK_TCK")
    cell.systemctl("restart")
    store = ("systemd-analyze", cell.scope.flag, "fdstore", cell.unit)
    assert run(*store).stdout.count("\ndora-life ") == 1


@pytest.mark.warns(*KILLED)
def test_a_stop_while_its_runner_waits_for_the_restart(cell: Cell, project: Project) -> None:
    words = ("--restart-policy", "always", "--restart-delay", "1s", "--max-restarts", "9")
    cell.start(project.three_nodes(), *words)
    for _ in range(3):
        wait_for("it runs", lambda: cell.show("ActiveState") == "active", 30)
        kill(cell, "runner")
        wait_for("it is away", lambda: cell.show("ActiveState") != "active")
    wait_for("its runner waits", lambda: "restarting in" in cell.show("StatusText"), 10)
    began = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - began < bound(5)
    assert (cell.show("ActiveState"), cell.show("Result")) == ("inactive", "success")


def test_always_restarts_what_ended_by_itself(cell: Cell, project: Project) -> None:
    project.write("short.py", FINISHING)
    flow = project.write("flow.yml", "nodes: [{id: short, path: short.py, restart_policy: never}]")
    cell.start(flow, "--restart-policy", "always", check=False)
    wait_for("it begins again", lambda: cell.messages("short").count("done") > 1)
    cell.doractl("stop", cell.name)
    assert cell.show("ActiveState") == "inactive"
    assert listed(cell)["status"] in ("Stopped", "Finished")


@pytest.mark.warns("not ready within", "Failed with result", "exited", "failed", "Failed to start")
def test_start_timeout_names_the_late(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("late.py", LATE)
    flow.write_text(flow.read_text().rstrip() + "\n  - {id: late, path: late.py}\n")
    seconds = format_duration(round(bound(3)) * SECOND)  # the other nodes are ready by then
    done = cell.start(flow, "--start-timeout", seconds, check=False)
    assert done.returncode == ExitCode.FAILURE
    assert f"node late was not ready within {seconds}" in done.stderr
    assert cell.show("ActiveState") == "failed"


@pytest.mark.warns("hang", "unresponsive", "was end", "SIGKILL", "Signal(9)", "restarted", "after")
def test_a_hang_is_called_one(cell: Cell, project: Project) -> None:
    project.write("hang.py", HANGING)
    project.write("source.py", project.three_nodes().with_name("source.py").read_text())
    text = (
        "health_check_interval: 0.5\nnodes:\n"
        "  - {id: source, path: source.py, inputs: {t: dora/timer/millis/50}, outputs: [number]}\n"
        "  - {id: hang, path: hang.py, health_check_timeout: 1.0,"
        " inputs: {n: {source: source/number, queue_size: 1000}}}\n"
    )
    cell.start(project.write("flow.yml", text), *ON_FAILURE)
    wait_for("it is found out", lambda: ("node-hung", "hang") in cell.events(), 60)
    wait_for("it is restarted", lambda: ("node-restarted", "hang") in cell.events())
    (crash, *_) = [one for one in cell.journal() if one.get("DORA_EVENT") == "node-ended"]
    assert crash["DORA_EXIT"].startswith("hung, unresponsive for ")


@pytest.mark.warns(*KILLED, "watchdog", "Watchdog", "Killing process", "SIGABRT", "core-dump")
def test_watchdog_restarts_a_runner_that_hangs(cell: Cell, project: Project) -> None:
    """Whatever the policy: its nodes have done nothing."""
    cell.start(project.three_nodes(), "--property", "WatchdogSec=2s")
    assert cell.show("Restart") == "no"
    runner = cell.supervisor_pid("runner")
    os.kill(runner, signal.SIGSTOP)
    wait_for("it is replaced", lambda: cell.show("NRestarts") == "1" and not is_alive(runner), 60)
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    cell.wait_exchanging()


def test_unknown_node(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("dataflow.systemd.yml", "nodes: {sinc: {restart_policy: always}}")
    done = cell.start(flow, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert "the node 'sinc': no such node" in done.stderr
    assert "did you mean sink" in done.stderr
    assert cell.show("LoadState") == "not-found"


FREEZE_SECONDS = 22
"""Longer than the 20 s after which dora's daemon and coordinator give each other up."""
AFTER_FREEZE = ("heartbeat", "failed watchdog", "syncing transport", "close message", "Discarding")


@pytest.mark.warns(*CRASHES, *KILLED, *AFTER_FREEZE)
def test_a_freeze_does_not_blind_it(cell: Cell, project: Project) -> None:
    """After a freeze, dora's daemon connects again, and the coordinator drops all subscribers."""
    cell.start(project.three_nodes(), "--node", "source:restart_policy=on-failure")
    cell.systemctl("freeze")
    time.sleep(FREEZE_SECONDS)  # there is nothing to wait for
    cell.systemctl("thaw")
    (old,) = cell.pids("node-source")
    sink = cell.status.nodes["sink"].pid
    restart = ("node", "restart", cell.name, "sink")
    # dora refuses it until its daemon is back.
    wait_for("a restart", lambda: cell.doractl(*restart, check=False).returncode == 0)
    wait_for("its process is known", lambda: cell.status.nodes["sink"].pid not in (0, sink))
    os.kill(old, signal.SIGKILL)
    wait_for("the crash is seen", lambda: ("node-crashed", "source") in cell.events())
    wait_for("it runs again", lambda: cell.status.nodes["source"].pid not in (0, old))
    cell.doractl("node", "stop", cell.name, "source")
    wait_for("it is stopped", lambda: cell.status.nodes["source"].state == "stopped")

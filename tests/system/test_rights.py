"""Rights of single nodes with real dora and systemd: what the kernel says that each process has.

A container may refuse what raises rights, and a kernel with CONFIG_RT_GROUP_SCHED realtime. Then
the start is refused; otherwise that node has it, and no other one.
"""

import json
import os
from pathlib import Path
from typing import NamedTuple

import pytest

from dora_systemd.adapters.cgroup.groups import mount_point, read_controllers
from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.refusals import IN_THE_JOURNAL, Refusal, check_refusals

HAS_CPUSET = "cpuset" in read_controllers(mount_point())
LAST = max(os.sched_getaffinity(0))
CRASHING = """
import sys
from dora import Node
for event in Node():
    if event["type"] == "INPUT":
        sys.exit(3)
"""
WAITING = "from dora import Node\nfor event in Node():\n    print('lives', flush=True)\n"
ESSENTIAL = """
nodes:
  - {id: bad, path: bad.py, inputs: {tick: dora/timer/millis/50}}
  - {id: other, path: other.py, inputs: {tick: dora/timer/millis/50}}
"""
CRASHES = ("crashed", "exit code 3", "ExitCode(3)", "restarted", "after failure", "Failed with")
FAILED = ("failed: ", "Failed to start", " failed")


class Rights(NamedTuple):
    """What the kernel says of a process."""

    policy: int
    priority: int
    nice: int
    oom: int
    cpus: frozenset[int]


def rights_of(pid: int) -> Rights:
    return Rights(
        os.sched_getscheduler(pid),
        os.sched_getparam(pid).sched_priority,
        os.getpriority(os.PRIO_PROCESS, pid),
        int(Path(f"/proc/{pid}/oom_score_adj").read_text()),
        frozenset(os.sched_getaffinity(pid)),
    )


def of_node(cell: Cell, node: str) -> Rights:
    """The rights of a node's own process."""
    return rights_of(cell.status.nodes[node].pid)


def hard_limit(pid: int, name: str) -> str:
    lines = Path(f"/proc/{pid}/limits").read_text().splitlines()
    (line,) = (one for one in lines if one.startswith(name))
    return line.removeprefix(name).split()[1]


@pytest.mark.warns("is being restarted")
def test_rights_of_one_node_and_of_the_others(cell: Cell, project: Project) -> None:
    cell.start(
        project.three_nodes(),
        "--node=sink:nice=5,scheduling=batch,oom_score_adjust=300,lock_memory=no",
        "--node=source:essential=yes",
        f"--node=source:cpus={LAST}",
        "--nice=2",
    )
    cell.wait_exchanging()
    everywhere = frozenset(os.sched_getaffinity(0))
    base = rights_of(cell.supervisor_pid("daemon"))
    assert (base.policy, base.nice, base.cpus) == (os.SCHED_OTHER, 2, everywhere)
    expected = {
        "sink": Rights(os.SCHED_BATCH, 0, 5, 300, everywhere),
        "source": base._replace(cpus=frozenset({LAST})),
        "doubler": base._replace(oom=min(base.oom + 500, 1000)),
    }
    assert {node: of_node(cell, node) for node in expected} == expected
    variables = Path(f"/proc/{cell.status.nodes['sink'].pid}/environ").read_bytes()
    assert b"DORA_SYSTEMD" not in variables
    before = cell.status.nodes["sink"].pid
    cell.doractl("node", "restart", cell.name, "sink")
    wait_for("another process", lambda: cell.status.nodes["sink"].pid not in (0, before))
    cell.wait_exchanging()
    assert of_node(cell, "sink") == expected["sink"]


def test_a_node_without_core_dumps(cell: Cell, project: Project) -> None:
    """Its limit is 0, that of the others as in the unit, also after a restart."""
    flow = project.three_nodes()
    project.write("dataflow.systemd.yml", "nodes: {sink: {core_dumps: no}}\n")
    cell.start(flow)
    cell.wait_exchanging()
    others = hard_limit(cell.supervisor_pid("daemon"), "Max core file size")
    assert others != "0"
    limits = {
        node: hard_limit(one.pid, "Max core file size") for node, one in cell.status.nodes.items()
    }
    assert limits == {"sink": "0", "source": others, "doubler": others}


RAISING = (
    "scheduling=fifo:5",
    "scheduling=rr:7",
    "nice=-5",
    "oom_score_adjust=-50",
    "lock_memory=yes",
)


@pytest.mark.warns(*IN_THE_JOURNAL, *FAILED, "OOM", "oom")
@pytest.mark.parametrize("right", RAISING)
def test_what_raises_rights_is_granted_to_one_node_or_refused(
    cell: Cell, project: Project, right: str
) -> None:
    flow = project.three_nodes()
    given = f"--node=sink:{right}"
    tried = cell.doractl("start", str(flow), "--name", cell.name, given, "--dry-run", check=False)
    done = cell.start(flow, given, check=False)
    assert tried.returncode == done.returncode, (tried.stderr, done.stderr)
    if done.returncode:
        assert done.returncode == ExitCode.NO_PERMISSION, done.stderr
        assert tried.stderr.splitlines()[0] == done.stderr.splitlines()[0].replace(
            f"start {cell.name}: ", ""
        )
        assert "cannot give the node sink its rights (" in done.stderr
        assert cell.is_gone
        assert cell.show("NRestarts") == "0"
        assert not {"node-ready", "node-exited"} & {name for name, _ in cell.events()}
        return
    cell.wait_exchanging()
    sink, others = cell.status.nodes["sink"].pid, (cell.status.nodes["source"].pid,)
    word, _, value = right.partition("=")
    number = value.rpartition(":")[2]
    found = {
        "scheduling": str(rights_of(sink).priority),
        "nice": str(rights_of(sink).nice),
        "oom_score_adjust": str(rights_of(sink).oom),
        "lock_memory": hard_limit(sink, "Max locked memory").replace("unlimited", "yes"),
    }
    assert found[word] == number
    for pid in others:
        own = rights_of(pid)
        assert (own.policy, own.nice, own.oom) == (os.SCHED_OTHER, 0, 0)
        assert hard_limit(pid, "Max realtime priority") == "0"
        assert hard_limit(pid, "Max nice priority") == "0"


def test_bad_rights(cell: Cell, project: Project) -> None:
    """All of them before systemd is asked for anything."""
    flow = str(project.three_nodes())
    usage, bad = ExitCode.USAGE, ExitCode.BAD_INPUT
    flags = {
        "--node=sink:scheduling=fifo:100": (usage, "fifo:PRIORITY with 1 to 99"),
        "--node=sink:scheduling=batsh": (usage, "did you mean batch?"),
        "--node=sink:nice=-21": (usage, "from -20"),
        "--node=sink:priority=5": (usage, "dora-systemd.yml(5)"),
        "--node=sink": (usage, "write NODE:"),
        "--node=snik:nice=5": (bad, "did you mean sink?"),
        "--node=sink:cpus=-1": (usage, "such as 2-3"),
        "--node=sink:cpus=8000": (bad, "this machine has none"),
    }
    refusals = [Refusal([flow, flag], *expected) for flag, expected in flags.items()]
    check_refusals(cell, project, refusals)
    for text, words in (
        ("nodes: {sink: {scheduling: fifo:100}}", "nodes.sink.scheduling in"),
        ("nodes: {sink: {cpus: [1]}}", "the value of cpus is of another type"),
        ("scheduling: fifo:5", "unknown key 'scheduling'"),
        ("nodes: {snik: {essential: true}}", "did you mean sink?"),
    ):
        project.write("dataflow.systemd.yml", text)
        check_refusals(cell, project, [Refusal([flow], bad, words)])


@pytest.mark.lab
def test_what_only_root_gives(cell: Cell, project: Project) -> None:
    """The owner of the dataflow may bind and lower nodes, and say which one is essential."""
    flow = project.three_nodes()
    run("chown", "-R", "alice:alice", str(project.root))
    project.write("dataflow.systemd.yml", "nodes: {sink: {nice: -5, essential: true}}")
    done = cell.start(flow, check=False)
    assert done.returncode == ExitCode.NO_PERMISSION
    assert "nodes.sink.nice is set there, and the file is not root's" in done.stderr
    project.write("dataflow.systemd.yml", "nodes: {sink: {nice: 5, essential: true, cpus: 0}}")
    cell.start(flow)
    cell.wait_exchanging()
    assert of_node(cell, "sink").nice == 5
    assert of_node(cell, "sink").cpus == {0}
    assert of_node(cell, "source").oom == 500


@pytest.mark.warns(*CRASHES, *FAILED)
@pytest.mark.parametrize("restarts", [0, 1])
def test_an_essential_node_ends_the_dataflow(cell: Cell, project: Project, restarts: int) -> None:
    project.write("bad.py", CRASHING)
    project.write("other.py", WAITING)
    flow = project.write("dataflow.yml", ESSENTIAL)
    policy = ("--restart-policy=on-failure", f"--max-restarts={restarts}") if restarts else ()
    cell.start(flow, "--node=bad:essential=yes", *policy)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed", 60)
    reason = "essential node bad: exit code 3" + (" after 1 restart" if restarts else "")
    assert (cell.show("StatusText"), cell.show("NRestarts")) == (f"failed: {reason}", "0")
    assert cell.show("ExecMainStatus") == ("70" if restarts else "1")
    why = json.loads(cell.doractl("why", cell.name, "-o", "json", check=False).stdout)
    assert (why["cause"], why["summary"], why["node"]) == ("node-failed", reason, "bad")
    ends = [event for event in cell.events() if event in (("node-exited", "other"),)]
    assert ends, "it was stopped, and did not crash"
    assert ("node-crashed", "other") not in cell.events()


@pytest.mark.warns(*CRASHES, *FAILED)
def test_a_reload_that_fails_and_leaves_it_down_ends_the_dataflow(
    cell: Cell, project: Project
) -> None:
    """Its old version has ended, and the old file is gone: nothing can be started again."""
    bad = project.write("bad.py", WAITING)
    project.write("other.py", WAITING)
    cell.start(project.write("dataflow.yml", ESSENTIAL), "--node=bad:essential=yes")
    bad.write_text("raise SystemExit(3)\n")
    refused = cell.doractl("reload", cell.name, check=False)
    assert "cannot use what was saved: node bad: exit code 3" in refused.stderr
    assert refused.returncode == 1
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    why = json.loads(cell.doractl("why", cell.name, "-o", "json", check=False).stdout)
    found = (why["cause"], why["summary"], why["node"])
    assert found == ("node-failed", "essential node bad: exit code 3", "bad")
    assert cell.show("ExecMainStatus") == "1"
    names = [name for name, _ in cell.events()]
    assert names.index("reload-failed") < names.index("dataflow-failed")
    assert ("node-crashed", "other") not in cell.events()


@pytest.mark.warns(*CRASHES, *FAILED)
def test_a_reload_that_goes_back_keeps_it(cell: Cell, project: Project) -> None:
    for name in ("bad.py", "other.py"):
        project.write(name, WAITING)
    project.write("new.py", "raise SystemExit(3)\n")
    flow = project.write("dataflow.yml", ESSENTIAL)
    cell.start(flow, "--node=bad:essential=yes")
    flow.write_text(ESSENTIAL.replace("bad.py", "new.py"))
    refused = cell.doractl("reload", cell.name, check=False)
    assert "the previous version is running again" in refused.stderr
    cell.wait_exchanging("bad")
    assert (cell.show("ActiveState"), cell.show("NRestarts")) == ("active", "0")


@pytest.mark.warns(*CRASHES, *FAILED)
def test_without_it_the_others_stay(cell: Cell, project: Project) -> None:
    project.write("bad.py", CRASHING)
    project.write("other.py", WAITING)
    cell.start(project.write("dataflow.yml", ESSENTIAL), "--node=other:essential=yes")
    wait_for("it has failed", lambda: cell.status.nodes["bad"].state == "failed")
    cell.wait_exchanging("other")
    assert cell.status.stage == "degraded"


@pytest.mark.skipif(HAS_CPUSET, reason="the launcher has nothing to do")
def test_cpus_without_a_controller(cell: Cell, project: Project) -> None:
    done = cell.start(project.three_nodes(), "--node=sink:cpus=0")
    assert "doractl: systemd has no cpuset controller here: sink can leave" in done.stderr
    changed = cell.doractl("set", cell.name, f"--node=sink:cpus={LAST}", check=False)
    assert changed.returncode == ExitCode.NO_SYSTEMD
    assert "cannot enforce cpus of the node sink" in changed.stderr
    assert of_node(cell, "sink").cpus == {0}


@pytest.mark.emulator
def test_cpus_of_a_running_node(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--node=sink:cpus=0")
    files = cell.group / "node-sink"
    assert (files / "cpuset.cpus.effective").read_text() == "0\n"
    cell.doractl("set", cell.name, f"--node=sink:cpus={LAST}")
    assert of_node(cell, "sink").cpus == {LAST}
    refused = cell.doractl("set", cell.name, "--node=sink:cpus=8000", check=False)
    assert refused.returncode == ExitCode.BAD_INPUT
    cell.doractl("set", cell.name, "--node=sink:cpus=infinity")
    assert of_node(cell, "sink").cpus == frozenset(os.sched_getaffinity(0))


def test_doctor_says_what_this_machine_offers() -> None:
    done = run("doractl", "doctor", "-o", "json", check=False)
    found = {one["topic"]: one for one in json.loads(done.stdout)}
    assert found["cpuset"]["state"] == ("ok" if HAS_CPUSET else "note")
    if os.geteuid() == 0:
        realtime = run("chrt", "--fifo", "1", "true", check=False)
        limit = run("prlimit", "--rtprio=99:99", "true", check=False)
        is_refused = realtime.returncode or limit.returncode
        assert found["real time"]["state"] == ("note" if is_refused else "ok")
        assert ("rights" in found) == bool(limit.returncode)

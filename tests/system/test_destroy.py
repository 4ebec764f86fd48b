"""doractl destroy: everything of one scope ends, in bounded time, and nothing else."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.place import SOCKET_UNIT
from dora_systemd.scope import Scope
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, is_alive, journalctl, run, wait_for
from tests.system.gateways import Front
from tests.system.test_stop import DEAF

# Stops all that runs, and looks at several users.
pytestmark = pytest.mark.lab

LEFT = "Nothing is left: no process in dora.slice.\n"
NOTHING = f"No dataflow is running.\n{LEFT}"
TICK = "inputs: {tick: dora/timer/millis/50}"
UNREADY = "import time\nprint('started', flush=True)\ntime.sleep(1000)\n"
FAILING = "import sys, dora\nnode = dora.Node()\nsys.exit(3)\n"
SLICE = Path("/sys/fs/cgroup/dora.slice")


@pytest.fixture
def others(cell: Cell) -> Iterator[list[Cell]]:
    """Two more dataflows, ended even if the test fails: what failed is the news then."""
    others = [Cell(f"{cell.name}-{n}") for n in (1, 2)]
    yield others
    for one in others:
        one.end()


def test_all_of_it(front: Front, cell: Cell, others: list[Cell], project: Project) -> None:
    flow = project.three_nodes()
    for one in (cell, *others):
        one.start(flow)
    front.up()
    pids = [pid for one in (cell, *others) for pid in one.all_pids()] + [front.pid]
    done = front.doractl("destroy")
    first, *stopped, shutting, ended, left = done.stdout.splitlines(keepends=True)
    assert first == "Stopping all dataflows...\n"
    assert sorted(stopped) == sorted(f"  ✓ {one.name} stopped\n" for one in (cell, *others))
    assert (shutting, ended) == ("Shutting down daemon...\n", "  ✓ Daemon stopped\n")
    assert (left, done.stderr) == (LEFT, "")
    assert not [pid for pid in pids if is_alive(pid)]
    assert not SLICE.exists()
    assert front.get("/health").status == 0
    assert not list(Path("/run/systemd/system").glob("dora-gateway*"))
    assert front.doractl("destroy").stdout == NOTHING
    assert front.doractl("destroy", "--force").stdout == NOTHING
    asked = journalctl("-o", "cat", f"DORA_DATAFLOW_NAME={cell.name}")
    assert "root (doractl destroy)" in asked


@pytest.mark.warns("not stopping within", "killed on drop", "Signal(9)", "signal", "killed")
@pytest.mark.parametrize("options", [(), ("--force",)])
def test_deaf_nodes(options: tuple[str, ...], front: Front, cell: Cell, project: Project) -> None:
    project.write("deaf.py", DEAF)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: deaf.py, {TICK}}}]")
    cell.start(flow, "--grace-duration", "2s")
    wait_for("it is deaf", lambda: "deaf" in cell.messages("one"))
    pids = cell.all_pids()
    begin = time.monotonic()
    done = front.doractl("destroy", *options)
    assert time.monotonic() - begin < bound(5 if options else 15)
    assert f"  ✓ {cell.name} stopped" in done.stdout
    assert done.stdout.endswith(LEFT)
    assert not [pid for pid in pids if is_alive(pid)]


@pytest.mark.warns("failed", "exit", "killed")
def test_between_two_restarts(front: Front, cell: Cell, project: Project) -> None:
    project.write("one.py", FAILING)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: one.py, {TICK}}}]")
    policy = ("--property", "Restart=always", "--property", "RestartSec=1h")
    cell.start(flow, *policy, check=False)
    wait_for("its restart is due", lambda: cell.show("SubState").startswith("auto-restart"))
    assert f"  ✓ {cell.name} stopped\n" in front.doractl("destroy").stdout
    assert cell.is_gone


@pytest.mark.warns("signal", "was killed", "not stopping", "killed on drop", "Signal")
def test_while_it_starts(front: Front, cell: Cell, project: Project) -> None:
    project.write("one.py", UNREADY)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: one.py, {TICK}}}]")
    cell.start(flow, "--no-wait", "--grace-duration", "1s", check=False)
    wait_for("it starts", lambda: cell.show("ActiveState") == "activating")
    wait_for("the node", lambda: "started" in cell.messages("one"))
    done = front.doractl("destroy")
    assert f"  ✓ {cell.name} stopped" in done.stdout
    assert done.stdout.endswith(LEFT)


@pytest.mark.warns("killed", "timed out", "timeout", "still around", "left-over", "remains")
def test_a_unit_that_systemd_does_not_kill(front: Front, cell: Cell, project: Project) -> None:
    project.write("deaf.py", DEAF)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: deaf.py, {TICK}}}]")
    never = ("--property", "SendSIGKILL=no", "--property", "TimeoutStopSec=1s")
    cell.start(flow, *never, "--grace-duration", "1h")
    wait_for("it is deaf", lambda: "deaf" in cell.messages("one"))
    pids = cell.all_pids()
    done = front.doractl("destroy")
    assert f"  ✓ {cell.name} stopped" in done.stdout
    assert done.stdout.endswith(LEFT)
    assert not [pid for pid in pids if is_alive(pid)]


def test_others_are_left_alone(
    front: Front, alice: Front, cell: Cell, project: Project, tmp_path: Path
) -> None:
    flow = project.three_nodes()
    hers = Cell("hers", Scope(is_user=True, uid=1000))
    alice.doractl("start", str(flow), "--name", "hers")
    alice.up()
    cell.start(flow)
    front.up()
    slept = ("sleep", "1000")
    run("systemd-run", "--slice=dora.slice", "--unit=foreign", *slept)
    run("systemd-run", "--slice=dora.slice", "--unit=dora-foreign", *slept)
    environment = {**os.environ, "HOME": str(tmp_path)}
    run("dora", "up", cwd=tmp_path, env=environment)
    try:
        before = _pids(alice), _pids(Front(), "foreign"), _pids(Front(), "dora-foreign")
        done = front.doractl("destroy")
        words = "Not touched in dora.slice, not managed by doractl: "
        words += "dora-foreign.service, foreign.service\n"
        assert words in done.stdout
        assert done.stdout.endswith(LEFT)
        after = _pids(alice), _pids(Front(), "foreign"), _pids(Front(), "dora-foreign")
        assert after == before
        assert all(before)
        assert run("dora", "list", cwd=tmp_path, env=environment).returncode == 0
        listed = json.loads(alice.doractl("list", "-o", "json").stdout)
        assert [one["name"] for one in listed] == ["hers"]
        assert alice.get("/nothing", user="alice").status == 404
        done = alice.doractl("destroy")
        assert "  ✓ hers stopped\n" in done.stdout
        assert "  ✓ Daemon stopped\n" in done.stdout
        assert alice.doractl("destroy").stdout == NOTHING
        assert _pids(Front(), "foreign") == before[1]
    finally:
        run("dora", "destroy", cwd=tmp_path, env=environment, check=False)
        run("systemctl", "stop", "foreign", "dora-foreign", check=False)
        alice.systemctl("stop", hers.unit, check=False)


def _pids(front: Front, unit: str = "") -> list[int]:
    """Those of a unit, or of all in the user's dora.slice."""
    group = front.show("ControlGroup", f"{unit}.service" if unit else "dora.slice")
    path = Path(f"/sys/fs/cgroup{group}")
    return sorted(int(p) for f in path.rglob("cgroup.procs") for p in f.read_text().split())


def test_what_is_enabled_stays_enabled(front: Front, cell: Cell, project: Project) -> None:
    run("doractl", "setup")
    try:
        cell.start(project.three_nodes(), "--enable")
        done = front.doractl("destroy")
        last = f"Still enabled: {cell.name}; they start at the next boot."
        assert done.stdout.splitlines()[-1] == last
        assert front.show("ActiveState", "dora.target") == "inactive"
        assert f"  ✓ Enabled dataflows started: {cell.name}\n" in front.doractl("up").stdout
        wait_for("it runs", lambda: cell.show("ActiveState") == "active")
        assert front.show("FragmentPath", SOCKET_UNIT).startswith("/usr/local/lib/systemd/")
        # Whoever has stopped it by hand is not asked again.
        cell.doractl("stop", cell.name)
        assert "Enabled" not in front.doractl("up").stdout
        assert cell.is_gone
        cell.doractl("disable", cell.name)
    finally:
        front.doractl("destroy")
        run("doractl", "setup", "--remove", check=False)

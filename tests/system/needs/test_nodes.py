"""Nodes that wait for a device, lose it and get it back, with real dora and systemd."""

import time
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, wait_for
from tests.system.needs.scene import fragile, node_of, seen, wait_running, wait_waiting, with_needs


def test_a_node_waits_and_comes_back(cell: Cell, project: Project, place: Path) -> None:
    camera = place / "video0"
    done = cell.start(with_needs(project, [camera]))
    assert f"source waits for {camera} (not there)" in done.stdout + done.stderr
    wait_waiting(cell, "source", camera)
    assert (seen(cell)["status"], cell.show("ActiveState")) == ("Waiting", "active")
    assert f"source waits for {camera}" in cell.doractl("why", cell.name).stdout
    assert "Waiting" in cell.doractl("list").stdout
    camera.touch()
    wait_running(cell)
    cell.wait_exchanging()
    others = {node: cell.status.nodes[node].pid for node in ("doubler", "sink")}

    camera.unlink()
    wait_waiting(cell, "source", camera)
    assert seen(cell)["status"] == "Waiting"
    assert {node: cell.status.nodes[node].pid for node in others} == others
    camera.touch()
    wait_running(cell)
    cell.wait_exchanging()
    assert {node: cell.status.nodes[node].pid for node in others} == others
    assert (node_of(cell, "source")["restarts"], cell.show("NRestarts")) == (0, "0")
    names = [name for name, node in cell.events() if node == "source"]
    assert [one for one in names if "wait" in one or "met" in one] == [
        *("node-waiting", "node-needs-met"),
        *("node-waiting", "node-needs-met"),
    ]
    assert "node-crashed" not in names


# Dora has not opened its start barrier: Node() of the others raises.
@pytest.mark.warns("ExitCode(1)")
def test_a_stop_ends_a_waiting_node_at_once(cell: Cell, project: Project, place: Path) -> None:
    cell.start(with_needs(project, [place / "video0"]), "--grace-duration", "60s")
    wait_waiting(cell, "source", place / "video0")
    begun = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - begun < 30
    assert cell.show("Result") == "success"


# The runner requests a restart while the driver ends: dora refuses that, and the driver waits too.
@pytest.mark.warns("driver crashed", "the device is gone", "ExitCode(1)", "exited with code 1",
                   "failed to restart node")  # fmt: skip
@pytest.mark.parametrize(("policy", "kept"), [("no", "latched"), ("on-failure", "on-failure")])
def test_a_driver_that_ends_by_itself_waits_too(
    cell: Cell, project: Project, place: Path, policy: str, kept: str
) -> None:
    device = place / "ttyUSB0"
    device.touch()
    cell.start(fragile(project, device), "--restart-policy", policy)
    sink = cell.status.nodes["sink"].pid
    for _ in range(3):
        device.unlink()
        wait_waiting(cell, "driver", device)
        device.touch()
        wait_running(cell)
        assert cell.status.nodes["sink"].pid == sink
        driver = cell.status.nodes["driver"]
        assert (driver.policy, driver.restarts) == (kept, 0)


@pytest.mark.warns("driver crashed", "ExitCode(1)", "essential node driver", "Failed with result")
def test_a_driver_that_fails_beside_its_device_is_given_up(
    cell: Cell, project: Project, place: Path
) -> None:
    device = place / "ttyUSB0"
    device.touch()
    path = fragile(project, device)
    project.write("driver.py", "from dora import Node\nnext(iter(Node()))\nraise SystemExit(1)\n")
    cell.start(path)
    wait_for("the essential node ends all", lambda: cell.show("ActiveState") == "failed")
    assert "node driver: exit code 1" in cell.doractl("why", cell.name).stdout

"""Nodes that need a network interface, which is taken away and comes back.

The kernel of the container has no CAN: a virtual Ethernet cable stands for the bus. What the kernel
sends of a bus that is off is in tests/unit/decisions/needs/test_links.py.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, run
from tests.system.needs.scene import node_of, seen, wait_running, wait_waiting, with_needs
from tests.unit.checkout import CHECKOUT

# Only root adds interfaces.
pytestmark = pytest.mark.lab

ROUNDS = int(os.environ.get("ROUNDS", "3"))
BUS, OTHER_END = "can7", "can7-end"
NEED = f"net:{BUS}"


def ip(*words: str) -> None:
    run("ip", "link", *words)


def plug(*ends: str) -> None:
    """Add the cable, and bring these ends up."""
    ip("add", BUS, "type", "veth", "peer", "name", OTHER_END)
    for end in ends:
        ip("set", end, "up")


@pytest.fixture(autouse=True)
def no_cable() -> Iterator[None]:
    yield
    run("ip", "link", "del", BUS, check=False)


def wait_for_reason(cell: Cell, reason: str) -> None:
    wait_waiting(cell, "source", f"{NEED} ({reason})")
    assert f"source waits for {NEED} ({reason})" in " ".join(
        cell.doractl("why", cell.name).stdout.split()
    )


def test_a_bus_that_comes_late_is_named_at_each_step(cell: Cell, project: Project) -> None:
    done = cell.start(with_needs(project, [NEED]))
    assert f"source waits for {NEED} (not there)" in done.stdout + done.stderr
    wait_for_reason(cell, "not there")
    plug()
    wait_for_reason(cell, "down")
    ip("set", BUS, "up")
    wait_for_reason(cell, "no carrier")
    ip("set", OTHER_END, "up")
    wait_running(cell)
    cell.wait_exchanging()
    ip("set", BUS, "down")
    wait_for_reason(cell, "down")
    assert seen(cell)["status"] == "Waiting"


def test_a_bus_is_taken_away_again_and_again(cell: Cell, project: Project) -> None:
    plug(BUS, OTHER_END)
    cell.start(with_needs(project, [NEED]))
    assert "AF_CAN" in cell.show("RestrictAddressFamilies").split()
    cell.wait_exchanging()
    others = {node: cell.status.nodes[node].pid for node in ("doubler", "sink")}
    for _ in range(ROUNDS):
        ip("del", BUS)
        wait_waiting(cell, "source", f"{NEED} (not there)")
        plug(BUS, OTHER_END)
        wait_running(cell)
        cell.wait_exchanging()
        assert {node: cell.status.nodes[node].pid for node in others} == others
    assert (node_of(cell, "source")["restarts"], cell.show("NRestarts")) == (0, "0")
    names = [name for name, node in cell.events() if node == "source"]
    assert names.count("node-waiting") == ROUNDS
    assert names.count("node-needs-met") == ROUNDS
    assert "node-crashed" not in names


def test_a_bus_that_was_away_for_a_moment_is_another_one(cell: Cell, project: Project) -> None:
    plug(BUS, OTHER_END)
    cell.start(with_needs(project, [NEED]))
    cell.wait_exchanging()
    before = cell.status.nodes["source"].pid
    ip("del", BUS)
    plug(BUS, OTHER_END)
    wait_running(cell)
    cell.wait_exchanging()
    assert cell.status.nodes["source"].pid != before
    assert node_of(cell, "source")["restarts"] == 0


@pytest.mark.parametrize("name", ["sixteen-letters0", "can/0", "can%d", "..", ""])
def test_a_name_that_cannot_be_changes_nothing(cell: Cell, project: Project, name: str) -> None:
    for flags in ((), ("--node", f"source:needs=net:{name}")):
        path = project.three_nodes() if flags else with_needs(project, [Path(f"net:{name}")])
        if flags:
            (project.root / "dataflow.systemd.yml").unlink()
        done = cell.start(path, *flags, check=False)
        lines = [line for line in done.stderr.splitlines() if "cannot" in line]
        assert len(lines) == 1, done.stderr
        assert f"net:{name}" in lines[0]
        assert cell.show("LoadState") == "not-found"


def test_the_unit_that_brings_a_bus_up_is_valid(tmp_path: Path) -> None:
    unit = tmp_path / "can@can0.service"
    unit.write_text((CHECKOUT / "examples/can/can@.service").read_text())
    done = run("systemd-analyze", "verify", "--man=no", str(unit), check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")

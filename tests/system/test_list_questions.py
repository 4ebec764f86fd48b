"""The table of `list` asks systemd little, and tells what systemd would have told."""

import json
import os
import signal
import time
from typing import Any

import pytest

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import table_rows
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.test_enable import boots

__all__ = ["boots"]


class CountingBus(Bus):
    """A connection to systemd that counts its questions."""

    questions = 0

    def _call(self, *words: Any, **more: Any) -> Any:
        self.questions += 1
        return super()._call(*words, **more)


def table_of(cell: Cell) -> tuple[int, dict[str, DataflowRow]]:
    """The number of questions that the table takes, and its rows by name."""
    bus = CountingBus(cell.scope, for_reading=True)
    rows = table_rows(bus, cell.scope, [one for one in read_cells(bus) if one.is_up])
    return bus.questions, {row.name: row for row in rows}


def row_of(cell: Cell) -> DataflowRow | None:
    return table_of(cell)[1].get(cell.name)


def check_truth(cell: Cell) -> None:
    """The row has what systemd has."""
    before = time.monotonic_ns() // 1000
    row = row_of(cell)
    after = time.monotonic_ns() // 1000
    assert row is not None and row.uptime is not None
    # The runner notes the time right before it tells systemd.
    assert before - row.uptime <= int(cell.show("ActiveEnterTimestampMonotonic"))
    assert after - row.uptime > int(cell.show("InactiveExitTimestampMonotonic"))
    assert row.restarts == int(cell.show("NRestarts"))
    assert f"--uuid={row.uuid}" in cell.show("ExecStart")


def is_running(cell: Cell) -> bool:
    row = row_of(cell)
    return row is not None and row.status == "Running" and row.nodes_alive == 3


def has_restarted(cell: Cell, number: int) -> bool:
    return int(cell.show("NRestarts")) == number


@pytest.fixture
def other(cell: Cell) -> Any:
    other = Cell(f"{cell.name}-other", cell.scope)
    yield other
    other.end()


@pytest.mark.warns("code=killed", "Failed with result", "status=69", "process was killed (")
def test_two_dataflows_take_as_many_questions_as_one(
    cell: Cell, other: Cell, project: Project
) -> None:
    flow = project.three_nodes()
    delays = ("--restart-delay", "2s", "--max-restart-delay", "2s")
    cell.start(flow, "--restart-policy", "always", *delays)
    # A start that takes as long as the delay does not prove that no life was before the first: then
    # the runner asks systemd some seconds later.
    wait_for("its runner knows its life", lambda: table_of(cell)[0] == 3)
    _, rows = table_of(cell)
    other.start(flow)
    questions, both = table_of(cell)
    assert questions == 3
    assert set(both) - set(rows) == {other.name}
    check_truth(cell)
    check_truth(other)
    assert f"({both[other.name].uuid})" in other.show("Description")
    # A run after a reload is the same life; a restart is another one.
    cell.doractl("reload", cell.name)
    check_truth(cell)
    for number, sign in enumerate((signal.SIGTERM, signal.SIGKILL), 1):
        os.kill(cell.supervisor_pid("runner"), sign)
        # systemd has not yet seen the end of a process that is just dead.
        wait_for("it is back", lambda n=number: has_restarted(cell, n) and is_running(cell))  # type: ignore[misc]
        check_truth(cell)
    cell.doractl("reset", cell.name)
    check_truth(cell)
    cell.doractl("restart", cell.name)
    check_truth(cell)


@pytest.mark.lab
@pytest.mark.warns("code=killed", "Failed with result", "process was killed (")
def test_an_enabled_dataflow_takes_none_of_its_own(boots: Cell, project: Project) -> None:
    """Its unit file is old, so only systemd can tell whether there was a life before the first."""
    boots.start(project.three_nodes(), "--restart-policy", "always")
    boots.doractl("enable", boots.name)
    boots.doractl("stop", boots.name)
    boots.doractl("restart", boots.name)
    assert boots.show("FragmentPath").startswith("/etc/")
    check_truth(boots)
    wait_for("its runner has asked", lambda: table_of(boots)[0] == 3)
    check_truth(boots)
    os.kill(boots.supervisor_pid("runner"), signal.SIGKILL)
    wait_for("it is back", lambda: boots.show("NRestarts") == "1" and is_running(boots))
    check_truth(boots)


def test_a_dataflow_of_an_older_version(cell: Cell, project: Project) -> None:
    """Its Description= has no UUID."""
    words = ("--property", f"Description=dora dataflow {cell.name}", "-o", "json")
    uuid = json.loads(cell.start(project.three_nodes(), *words).stdout)["uuid"]
    assert cell.show("Description") == f"dora dataflow {cell.name}"
    check_truth(cell)
    assert f"Dataflow: {uuid}" in cell.doractl("list", uuid[:8]).stdout
    assert uuid in cell.doractl("stop", cell.name).stdout


def test_a_foreign_unit_with_our_description(cell: Cell, project: Project) -> None:
    """Nobody acts on it, and it is no dataflow for programs."""
    cell.start(project.three_nodes())
    uuid = "550e8400-e29b-41d4-a716-446655440000"
    fake = Cell(f"{cell.name}-fake", cell.scope)
    words = (f"--description=dora dataflow {fake.name} ({uuid})", f"--unit={fake.unit}")
    flag = cell.scope.flag
    run("systemd-run", flag, "--quiet", *words, "sleep", "infinity")
    try:
        for verb in ("stop", "list", "restart", "reset", "why"):
            done = fake.doractl(verb, fake.name, check=False)
            assert f"no dataflow named '{fake.name}'" in done.stderr, verb
        names = [one["name"] for one in json.loads(cell.doractl("list", "-o", "json").stdout)]
        assert names == [cell.name]
        cell.doractl("stop", "--all")
        assert fake.show("ActiveState") == "active"
    finally:
        run("systemctl", flag, "stop", fake.unit)

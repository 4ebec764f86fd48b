"""Who ran out of memory, and how that is said."""

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora.life_events import with_facts
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.states import Cell, Record, State
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.resources.oom import Oom, OomCounts, Owner, find_owner, largest

MIB = 1 << 20


@pytest.mark.parametrize(
    ("node", "unit", "owner"),
    [
        (OomCounts(0, 0), OomCounts(0, 0), None),
        (OomCounts(0, 1), OomCounts(0, 0), None),  # memory was found after all
        (OomCounts(2, 1), OomCounts(2, 0), Owner.NODE),
        (OomCounts(1, 0), OomCounts(1, 1), Owner.DATAFLOW),
        (OomCounts(1, 1), OomCounts(1, 1), Owner.NODE),
        (OomCounts(1, 0), OomCounts(1, 0), Owner.MACHINE),
    ],
)
def test_owner(node: OomCounts, unit: OomCounts, owner: Owner | None) -> None:
    assert find_owner((OomCounts(), node), (OomCounts(), unit)) is owner
    seen = OomCounts(7, 7), OomCounts(7 + node.kills, 7 + node.refusals)
    seen_unit = OomCounts(9, 9), OomCounts(9 + unit.kills, 9 + unit.refusals)
    assert find_owner(seen, seen_unit) is owner


def test_words() -> None:
    own = Oom(Owner.NODE, 64 * MIB, 64 * MIB)
    assert own.text == "out of memory, peak 64M, limit 64M"
    assert own.node_details()["limit"] == str(64 * MIB)
    whole = Oom(Owner.DATAFLOW, 64 * MIB, 700 * MIB, "other", 500 * MIB)
    assert whole.text == "out of memory, peak 64M, limit of the dataflow 700M"
    assert whole.dataflow_details()["reason"] == "of 700M the node other held most, 500M"
    machine = Oom(Owner.MACHINE, 64 * MIB)
    assert machine.text == "out of memory, peak 64M, the machine had no memory left"
    assert "limit" not in machine.node_details()


def test_largest() -> None:
    assert largest({}) == ("", 0)
    assert largest({"a": 1, "b": 3, "c": 2}) == ("b", 3)


def records(oom: Oom, will_restart: bool = False) -> tuple[Cell, list[Record]]:
    """What the death of node "a" makes of a cell that runs."""
    event = life.NodeExited(5, "a", exit_of(-9), will_restart)
    cell = Cell(0, 0, {"a": NodeStatus("running", 7), "b": NodeStatus("running", 8)}, State.RUNNING)
    after, actions = step(cell, with_facts(event, False, oom))
    return after, [one for one in actions if isinstance(one, Record)]


def test_a_node_at_its_own_limit() -> None:
    oom = Oom(Owner.NODE, 64 * MIB, 64 * MIB)
    after, said = records(oom, will_restart=True)
    assert after.nodes["a"].state == "restarting"
    assert after.nodes["a"].exit == Exit(words=oom.text)
    assert said == [Record("node-oom", "a", oom.node_details())]
    again = step(after, life.NodeSpawned(6, "a", 9))[0]
    assert again.nodes["a"].exit == Exit(words=oom.text), "it stays to be seen"


def test_the_dataflow_at_its_limit() -> None:
    oom = Oom(Owner.DATAFLOW, 64 * MIB, 700 * MIB, "b", 500 * MIB)
    after, said = records(oom)
    assert after.nodes["a"].state == "failed"
    assert said == [
        Record("dataflow-oom", "", oom.dataflow_details()),
        Record("node-oom", "a", oom.node_details()),
    ]


def test_the_dataflow_without_its_daemon() -> None:
    oom = Oom(Owner.DATAFLOW, 19 * MIB, 700 * MIB, "b", 500 * MIB)
    cell = Cell(0, 0, {"b": NodeStatus("running", 8)}, State.RUNNING)
    after, actions = step(cell, life.ChildExited(5, "daemon", Exit(words=oom.text), oom))
    said = [one for one in actions if isinstance(one, Record)]
    assert [one.event for one in said] == ["dataflow-oom", "daemon-lost", "dataflow-failed"]
    assert after.failure == (
        "the dora daemon is gone (out of memory, peak 19M, limit of the dataflow 700M)"
    )
    assert after.cause is Cause.OUT_OF_MEMORY
    assert said[-1].details == {
        "reason": after.failure,
        "cause": "out-of-memory",
        "owner": "dataflow",
        "limit": str(700 * MIB),
    }


def test_doras_verdict_does_not_hide_it() -> None:
    oom = Oom(Owner.NODE, 64 * MIB, 64 * MIB)
    after = records(oom)[0]
    after = step(after, life.RunFinished(6))[0]
    after = step(after, life.ResultKnown(7, {"a": exit_of(-9), "b": exit_of(1)}))[0]
    assert after.failure == f"node a: {oom.text}, node b: exit code 1"
    assert after.nodes["a"].exit == Exit(words=oom.text)


def test_a_node_that_ended_well_did_not_want_memory() -> None:
    event = with_facts(life.NodeExited(5, "a", Exit(), False), False, Oom(Owner.NODE, 1, 1))
    assert (event.exit, event.oom) == (Exit(), None)

"""The live table while reloads change which nodes there are."""

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.node_table import NodeTable, has_process, update, with_downstream
from dora_systemd.decisions.life.states import Record

RUNNING = {"a": NodeStatus("running", 7, restarts=2, policy=HELD)}


def reshape(nodes: NodeTable, event: life.Event) -> NodeTable:
    after, records = update(nodes, event, is_stopping=False, is_open=True)
    assert not records
    return after


def updated(nodes: dict[str, NodeStatus], *events: life.Event) -> list[str]:
    """States of `a` after each event, and what the journal was told."""
    found = []
    table: NodeTable = nodes
    for event in events:
        table, records = update(table, event, is_stopping=False, is_open=True)
        found.append(" ".join((table["a"].state, *(one.event for one in records))))
    return found


def test_a_swap_is_no_crash_and_no_restart() -> None:
    fresh = NodeStatus(policy=HELD)
    assert updated(
        RUNNING,
        life.NodeReloading(1, "a", fresh),
        life.NodeExited(2, "a", Exit(), True),
        life.NodeSpawned(3, "a", 8),
        life.NodeReady(4, "a"),
    ) == ["reloading", "reloading node-exited", "starting", "running node-ready"]


def test_the_old_one_may_end_after_its_successor_has_begun() -> None:
    assert updated(
        RUNNING,
        life.NodeReloading(1, "a"),
        life.NodeSpawned(2, "a", 8),
        life.NodeExited(3, "a", exit_of(-15), False, is_stale=True),
        life.NodeReady(4, "a"),
    ) == ["reloading", "starting", "starting", "running node-ready"]


def test_a_node_that_is_held_fails_and_is_not_restarted() -> None:
    nodes, (record,) = update(
        RUNNING, life.NodeExited(1, "a", exit_of(1), True), is_stopping=False, is_open=True
    )
    assert (nodes["a"].state, nodes["a"].restarts, record.event) == ("failed", 2, "node-crashed")


CRASHING = {"a": NodeStatus("running", 7, policy="on-failure")}


def test_a_restart_counts_when_it_happens() -> None:
    """A node that is stopped in its restart delay is not restarted; `why` would not list it."""
    nodes, records = update(
        CRASHING, life.NodeExited(1, "a", exit_of(1), True), is_stopping=False, is_open=True
    )
    assert [one.event for one in records] == ["node-crashed"]
    assert (nodes["a"].state, nodes["a"].restarts) == ("restarting", 0)
    nodes, records = update(nodes, life.NodeSpawned(2, "a", 8), is_stopping=False, is_open=True)
    assert records == (Record("node-restarted", "a", {"restarts": "1"}),)
    assert (nodes["a"].state, nodes["a"].restarts) == ("starting", 1)


def test_an_exit_that_comes_after_the_restart_is_told_first() -> None:
    assert updated(
        CRASHING,
        life.NodeSpawned(1, "a", 8),
        life.NodeExited(2, "a", exit_of(1), True, is_stale=True),
        life.NodeReady(3, "a"),
    ) == ["starting", "starting node-crashed node-restarted", "running node-ready"]


CRASH = exit_of(1)


@pytest.mark.parametrize(
    "events, expected",
    [
        # As on a head: it does not know whether the exit of a node elsewhere is stale.
        (
            (
                life.NodeSpawned(1, "a", 0),
                life.NodeExited(2, "a", CRASH, True),
                life.NodeReady(3, "a"),
            ),
            ["starting", "restarting node-crashed", "running node-restarted node-ready"],
        ),
        # In a crash loop: the new process had ended, too, when dora said so of the old one.
        (
            (
                life.NodeSpawned(1, "a", 8),
                life.NodeExited(2, "a", CRASH, True),
                life.NodeExited(3, "a", CRASH, True),
                life.NodeSpawned(4, "a", 9),
            ),
            [
                "starting",
                "restarting node-crashed",
                "restarting node-restarted node-crashed",
                "starting node-restarted",
            ],
        ),
    ],
)
def test_a_restart_counts_by_any_word_of_the_new_process(
    events: tuple[life.Event, ...], expected: list[str]
) -> None:
    assert updated(CRASHING, *events) == expected


def test_processes_of_a_node_that_reloads() -> None:
    reloading = reshape(RUNNING, life.NodeReloading(1, "a"))
    assert has_process(reloading)
    assert not has_process({"a": reloading["a"]._replace(pid=0)})


def test_nodes_come_and_go() -> None:
    more = reshape(RUNNING, life.NodeAdded(1, "b", NodeStatus()))
    assert set(more) == {"a", "b"}
    assert set(reshape(more, life.NodeRemoved(1, "a"))) == {"b"}


def test_only_failures_name_whom_they_starve() -> None:
    fed = {"a": ("b", "c"), "c": ()}
    crash = Record("node-crashed", "a", {"exit": "exit code 1"})
    assert with_downstream(crash, fed).details == {"exit": "exit code 1", "downstream": "b c"}
    for event, node in (("node-exited", "a"), ("node-crashed", "c"), ("node-oom", "x")):
        assert with_downstream(Record(event, node), fed) == Record(event, node)

"""The nodes of a dataflow that has ended, from its events."""

from dora_systemd.decisions.why.lives import Happening, Life
from dora_systemd.decisions.why.nodes import ended_nodes


def life(*events: tuple[str, str] | tuple[str, str, str]) -> Life:
    """Each event: name, node and exit."""
    found = []
    for at_us, (name, node, *exit) in enumerate(events, 1):
        found.append(Happening(name, at_us, node, details={"exit": exit[0]} if exit else {}))
    return Life(tuple(found))


def states(*events: tuple[str, str] | tuple[str, str, str]) -> dict[str, tuple[str, str]]:
    return {row.node: (row.state, row.exit) for row in ended_nodes(life(*events))}


def test_how_each_node_was_left() -> None:
    found = states(
        ("node-ready", "camera"),
        ("node-ready", "plot"),
        ("node-ready", "arm"),
        ("node-crashed", "camera", "exit code 3"),
        ("node-exited", "plot"),
        ("dataflow-stopping", ""),
        ("node-exited", "arm", "exit code 1"),
    )
    assert found == {
        "camera": ("failed", "exit code 3"),
        "plot": ("finished", ""),
        "arm": ("stopped", "exit code 1"),
    }


def test_a_node_that_somebody_had_stopped() -> None:
    asked = Happening("node-asked", 2, "plot", details={"asked": "stop"})
    exited = Happening("node-exited", 3, "plot", details={"asked": "stop", "exit": "exit code 3"})
    again = Happening("node-asked", 4, "plot", details={"asked": "restart"})
    ready = (Happening("node-ready", 1, "plot"),)
    (row,) = ended_nodes(Life((*ready, asked, exited, again)))
    assert (row.state, row.exit) == ("stopped", "exit code 3")
    (row,) = ended_nodes(Life((*ready, asked)))
    assert row.state == "stopped"


def test_restarts_are_counted_and_the_last_exit_stays() -> None:
    (row,) = ended_nodes(
        life(
            ("node-ready", "a"),
            ("node-crashed", "a", "exit code 1"),
            ("node-restarted", "a"),
            ("node-ready", "a"),
            ("node-oom", "a", "out of memory"),
        )
    )
    assert (row.state, row.restarts, row.exit, row.since) == ("failed", 1, "out of memory", 5)


def test_nothing_runs_when_the_unit_has_ended() -> None:
    rows = ended_nodes(life(("node-ready", "a"), ("node-restarted", "b"), ("unit-failed", "")))
    assert {row.node: row.state for row in rows} == {"a": "stopped", "b": "stopped"}
    assert {row.since for row in rows} == {3}


def test_nodes_that_never_became_ready() -> None:
    end = Happening("dataflow-failed", 9, details={"nodes": "late other"})
    rows = ended_nodes(Life((end,)))
    assert [(row.node, row.state) for row in rows] == [("late", "failed"), ("other", "failed")]
    assert ended_nodes(Life()) == ()

"""The message bus restarts: no dataflow depends on it.

A user's bus, because the lab's own commands need the system's.
"""

import json
import shlex

import pytest

from tests.system.cells import Cell, Project, run, wait_for


def as_alice(*words: str) -> str:
    command = f"XDG_RUNTIME_DIR=/run/user/1000 exec {shlex.join(words)}"
    return run("su", "alice", "-s", "/bin/sh", "-c", command).stdout


def bus_pid() -> int:
    words = ("systemctl", "--user", "show", "--value", "-p", "MainPID", "dbus.service")
    return int(as_alice(*words))


def nodes() -> dict[str, int]:
    row = json.loads(as_alice("doractl", "list", "hers", "-o", "json"))
    assert (row["status"], row["nodes_alive"]) == ("Running", 3)
    return {one["node"]: one["pid"] for one in row["nodes"]}


def lines() -> int:
    words = ("doractl", "logs", "hers", "--node", "sink", "-o", "cat", "--no-pager")
    return len(as_alice(*words).splitlines())


@pytest.mark.lab
def test_a_bus_that_restarts(cell: Cell, project: Project) -> None:
    del cell  # for its look at the journal
    flow = project.three_nodes()
    as_alice("doractl", "start", str(flow), "--name", "hers")
    try:
        before, bus = nodes(), bus_pid()
        as_alice("systemctl", "--user", "restart", "dbus.service")
        wait_for("another bus", lambda: bus_pid() not in (0, bus))
        assert nodes() == before
        count = lines()
        wait_for("it goes on", lambda: lines() > count)
    finally:
        as_alice("doractl", "stop", "hers")
    assert as_alice("doractl", "list") == "No dataflow is running.\n"

"""doractl VERB -o json with real dataflows: one schema, outcomes, errors. dora-systemd-json(7)."""

import json
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for

LIVE = ("uptime_us", "cpu_percent", "memory_bytes", "memory_peak_bytes", "waits_percent")
"""What changes between two readings."""


def found(cell: Cell, *words: str, status: int = 0) -> Any:
    """What a verb prints."""
    done = cell.doractl(*words, "-o", "json", check=False)
    assert (done.returncode, done.stderr) == (status, "")
    return json.loads(done.stdout)


def settled(values: dict[str, Any]) -> dict[str, Any]:
    nodes = [{key: one[key] for key in one.keys() - {*LIVE}} for one in values["nodes"]]
    return {**{key: values[key] for key in values.keys() - {*LIVE, "schema"}}, "nodes": nodes}


def test_one_dataflow_everywhere(cell: Cell, project: Project) -> None:
    words = ("--restart-policy", "on-failure", "--max-restarts", "5")
    flow = project.three_nodes()
    cell.start(flow, *words)
    cell.wait_exchanging()
    one = found(cell, "list", cell.name)
    (listed,) = [row for row in found(cell, "list") if row["name"] == cell.name]
    look = found(cell, "top", cell.name, "--once")
    why = found(cell, "why", cell.name)
    assert one["schema"] == listed["schema"] == look["schema"] == why["schema"] == 1
    (top,) = look["dataflows"]
    own = {key: one[key] for key in ("started", "started_us")}
    assert settled(one) == settled(listed) == settled({**top, **own})
    assert one["started_us"] < one["ready_us"]
    assert why.keys() >= one.keys()
    assert settled({key: why[key] for key in one}) == settled(one)
    assert (one["file"], one["enabled"], one["nodes_total"]) == (str(flow), False, 3)
    assert one["restart_budget"] == {"used": 0, "max": 5, "next_us": None, "resets_us": None}
    assert abs(one["ready_us"] - look["at_us"]) < 600_000_000
    assert one["ready"].endswith("Z")
    assert one["ended"] is None


def test_outcomes(cell: Cell, project: Project) -> None:
    started = cell.start(project.three_nodes(), "-o", "json")
    subject = {"name": cell.name, "unit": cell.unit, "uuid": json.loads(started.stdout)["uuid"]}
    acts = [json.loads(started.stdout)]
    cell.wait_exchanging()
    acts += [
        found(cell, "set", cell.name, "--hot-reload", "on"),
        found(cell, "reload", cell.name),
        found(cell, "node", "stop", cell.name, "sink"),
        found(cell, "restart", cell.name),
        found(cell, "reset", cell.name),
        found(cell, "disable", cell.name),
        found(cell, "stop", cell.name),
        found(cell, "stop", cell.name),
    ]
    assert all(one.keys() == acts[0].keys() for one in acts)
    assert all({key: one[key] for key in subject} == subject for one in acts)
    assert [(one["action"], one["result"]) for one in acts] == [
        ("start", "done"),
        ("set", "done"),
        ("reload", "unchanged"),
        ("node stop", "done"),
        ("restart", "done"),
        ("reset", "done"),
        ("disable", "unchanged"),
        ("stop", "done"),
        ("stop", "unchanged"),
    ]
    assert all(one["error"] is None for one in acts)
    assert acts[3]["node"] == "sink"


@pytest.mark.lab
def test_a_boot_is_seen_everywhere(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    try:
        enabled = found(cell, "enable", cell.name)
        assert (enabled["result"], cell.unit in enabled["details"]["unit_file"]) == ("done", True)
        (top,) = found(cell, "top", cell.name, "--once")["dataflows"]
        assert top["enabled"] is found(cell, "why", cell.name)["enabled"] is True
        cell.doractl("stop", cell.name)
        status = ExitCode.NOT_RUNNING
        assert found(cell, "list", cell.name, status=status)["enabled"] is True
        (row,) = [one for one in found(cell, "list", "--all") if one["name"] == cell.name]
        assert row["enabled"] is True
    finally:
        cell.doractl("disable", cell.name)


def test_one_that_has_ended(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    cell.doractl("stop", cell.name)
    wait_for("it is gone", lambda: cell.is_gone)
    assert cell.doractl("reset", cell.name, check=False).returncode == ExitCode.NOT_RUNNING
    listed = found(cell, "list", cell.name, status=ExitCode.NOT_RUNNING)
    why = found(cell, "why", cell.name)
    told = {key: value for key, value in listed.items() if value is not None}
    assert {key: why[key] for key in told} == told
    assert why["started_us"] < why["ready_us"] < why["ended_us"]
    assert (listed["ready"], listed["uptime_us"], listed["nodes_total"]) == (None, None, None)
    assert listed["ended_us"] > 0


def test_errors(cell: Cell) -> None:
    for words in (
        ["list", "nosuch"],
        ["stop", "nosuch"],
        ["why", "nosuch"],
        ["node", "stop", "nosuch", "x"],
    ):
        done = run("doractl", cell.scope.flag, *words, "-o", "json", check=False)
        assert done.stdout == ""
        error = json.loads(done.stderr)["error"]
        assert error["message"].startswith("no dataflow named")
        assert error["exit_status"] == done.returncode == ExitCode.NOT_FOUND
    done = run("doractl", "list", "-o", "json", "--nosuch", check=False)
    assert json.loads(done.stderr)["error"]["exit_status"] == ExitCode.USAGE == done.returncode

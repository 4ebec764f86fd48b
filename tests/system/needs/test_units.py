"""What a whole dataflow needs: other dataflows and units, with real systemd."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, run, wait_for

TIMER = "nodes: [{id: sink, path: sink.py, inputs: {double: dora/timer/millis/50}}]\n"


@pytest.fixture
def base(cell: Cell) -> Iterator[Cell]:
    base = Cell(f"{cell.name[:50]}-base")
    yield base
    base.end()


def one_node(project: Project) -> Path:
    project.three_nodes()
    return project.write("dataflow.yml", TIMER)


def refusal(cell: Cell, project: Project, need: str, flag: str = "--needs") -> str:
    """The error of a start with this need, which has changed nothing."""
    done = cell.start(one_node(project), flag, need, check=False)
    assert done.returncode != 0
    assert cell.show("LoadState") == "not-found"
    lines = [line for line in done.stderr.splitlines() if "cannot" in line]
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_a_dataflow_stops_with_the_one_that_it_needs(
    cell: Cell, base: Cell, project: Project
) -> None:
    assert f"no dataflow named '{base.name}'" in refusal(cell, project, f"dataflow:{base.name}")
    base.start(one_node(project))
    cell.start(one_node(project), "--needs", f"dataflow:{base.name}")
    assert base.unit in cell.show("Requires").split()
    assert base.unit in cell.show("After").split()
    pid = cell.show("MainPID")
    run("systemctl", base.scope.flag, "restart", base.unit)
    wait_for("it restarts too", lambda: cell.show("MainPID") not in (pid, "0"))
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    done = base.doractl("stop", base.name)
    assert f"{cell.name} needs {base.name} and ends with it" in done.stderr
    assert done.stdout.count("Dataflow stopped: ") == 2
    assert cell.is_gone
    assert cell.show("Result") == "success"
    assert f"(doractl stop {base.name})" in cell.doractl("why", cell.name).stdout


@pytest.mark.warns("Dependency failed for")
def test_a_unit_that_is_needed_and_fails_is_named(cell: Cell, project: Project) -> None:
    flag, unit = cell.scope.flag, f"{cell.name[:50]}-false.service"
    words = [f"--unit={unit}", "--property=Type=oneshot", "--remain-after-exit", "false"]
    run("systemd-run", flag, *words, check=False)
    try:
        done = cell.start(one_node(project), "--needs", f"unit:{unit}", check=False)
    finally:
        run("systemctl", flag, "reset-failed", unit, check=False)
    assert f"cannot start {cell.name}: {unit}, which it needs, failed" in done.stderr
    assert f"hint: systemctl {flag} status {unit} shows more" in done.stderr


def test_a_dataflow_stops_with_a_unit_whose_name_is_escaped(cell: Cell, project: Project) -> None:
    flag, unit = cell.scope.flag, f"{cell.name[:50]}-a\\x2db.service"
    run("systemd-run", flag, "--collect", f"--unit={unit}", "sleep", "infinity")
    try:
        cell.start(one_node(project), "--needs", f"unit:{unit}")
    finally:
        run("systemctl", flag, "stop", unit)
    wait_for("it stops too", lambda: cell.is_gone)
    assert cell.show("Result") == "success"


def test_bad_needs_are_refused_before_anything_starts(cell: Cell, project: Project) -> None:
    assert "cannot wait for 'netwrok'" in refusal(cell, project, "netwrok")
    assert "wait for each other" in refusal(cell, project, f"dataflow:{cell.name}")
    assert "unit no-such.service is not-found" in refusal(cell, project, "unit:no-such.service")
    assert "no mount unit" in refusal(cell, project, "mount:/mnt/nowhere")
    assert "no such node" in refusal(cell, project, "camera:needs=/dev/video0", "--node")
    assert "a path is what a node needs" in refusal(cell, project, "/dev/video0")


@pytest.mark.skipif(os.geteuid() != 0, reason="needs another user's file")
def test_only_root_makes_systemd_start_other_units(cell: Cell, project: Project) -> None:
    dataflow = one_node(project)
    settings = project.write("dataflow.systemd.yml", "needs: [network, 'unit:reboot.target']\n")
    for path in (project.root, dataflow, settings):
        os.chown(path, 1000, 1000)
    done = cell.start(dataflow, check=False)
    assert done.returncode != 0
    assert "needs is set there, and the file is not root's" in done.stderr
    settings.write_text("needs: network\n")
    properties = cell.start(dataflow, "--dry-run").stdout
    assert "Wants=network-online.target" in properties
    assert "reboot.target" not in properties


def test_a_device_opens_its_group_and_no_other(cell: Cell, project: Project) -> None:
    dataflow = one_node(project)
    unit = cell.start(dataflow, "--node", "sink:needs=/dev/pts/77", "--dry-run").stdout
    if cell.scope.is_user:
        assert "DeviceAllow" not in unit
        return
    assert [line for line in unit.splitlines() if "Device" in line] == [
        *("DevicePolicy=closed", "DeviceAllow=char-pts rw"),
    ]

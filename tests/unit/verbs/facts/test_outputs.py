"""Owed outputs as readers outside the cell see them: the file of times is the nodes' user's."""

import os
import struct
import time
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.views.facts import OutputRow
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_times
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import dataflow_row
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import FakeManager, options, with_limits, with_owes, with_rights
from tests.unit.fakes.rights_values import rights_from
from tests.unit.verbs.facts.test_list import GROUP, scope, unit_group, write_status

__all__ = ["scope", "unit_group"]

OWES = (Owed("camera", "image", 2 * SECOND), Owed("camera", "depth", SECOND, then="warn"))


def outputs(scope: Scope, data: bytes) -> tuple[OutputRow, ...]:
    manager = FakeManager()
    manager.add(with_owes(options(), *OWES), ControlGroup=GROUP)
    write_status(scope, CellStatus(nodes={"camera": NodeStatus("running")}))
    (scope.cell_directory("robot") / "times").write_bytes(data)
    (camera,) = dataflow_row(manager, scope, read_cells(manager)[0]).nodes
    return camera.outputs


@pytest.mark.usefixtures("unit_group")
def test_ages(scope: Scope) -> None:
    now = time.monotonic_ns() // 1000
    image, depth = outputs(scope, struct.pack("=3Q", now, now - 3 * SECOND, 0))
    assert image.age is not None
    assert 3 * SECOND <= image.age < 60 * SECOND
    assert (depth.output, depth.within, depth.then, depth.age) == ("depth", SECOND, "warn", None)


@pytest.mark.parametrize("now", ["", "0-1\n"])
def test_cpus(scope: Scope, unit_group: Path, now: str) -> None:
    """With a cpuset controller, the kernel knows better than the settings."""
    if now:
        (unit_group / "node-camera/cpuset.cpus").write_text(now)
    manager = FakeManager()
    limits = (limits_from("camera:cpus=2-3"), limits_from("plot:memory_limit=1G"))
    manager.add(with_limits(options(), *limits), ControlGroup=GROUP)
    nodes = {one: NodeStatus("running") for one in ("camera", "plot", "ui")}
    write_status(scope, CellStatus(nodes=nodes))
    rows = dataflow_row(manager, scope, read_cells(manager)[0]).nodes
    assert [row.cpus for row in rows] == [now.strip() or "2-3", "", ""]


@pytest.mark.usefixtures("unit_group")
@pytest.mark.parametrize("data", [b"", b"x" * 23, b"\xff" * 24, bytes(25), b"x" * 10_000_000])
def test_what_no_probe_writes(scope: Scope, data: bytes) -> None:
    assert [one.age for one in outputs(scope, data)] == [None, None]


def test_other_files_in_its_place(tmp_path: Path) -> None:
    assert read_times(tmp_path, 24) == b""
    times = tmp_path / "times"
    os.mkfifo(times)
    assert read_times(tmp_path, 24) == b""
    times.unlink()
    times.mkdir()
    assert read_times(tmp_path, 24) == b""
    times.rmdir()
    (tmp_path / "secret").write_bytes(b"x" * 24)
    times.symlink_to(tmp_path / "secret")
    if os.geteuid() == 0:  # links are refused to root alone
        os.chown(tmp_path, 1000, 1000)
        os.lchown(times, 1000, 1000)
        assert read_times(tmp_path, 24) == b""


@pytest.mark.usefixtures("unit_group")
def test_what_is_special_about_nodes(scope: Scope) -> None:
    manager = FakeManager()
    rights = (rights_from("camera:essential=yes,scheduling=batch"),)
    manager.add(with_rights(options(), *rights), ControlGroup=GROUP)
    nodes = {one: NodeStatus("running") for one in ("camera", "plot")}
    write_status(scope, CellStatus(nodes=nodes))
    camera, plot = dataflow_row(manager, scope, read_cells(manager)[0]).nodes
    assert (camera.essential, camera.scheduling) == (True, "batch")
    assert (plot.essential, plot.scheduling) == (False, "")

"""What a view does with the dataflow or node that a person has chosen, and what it hears of it."""

import fcntl
import os
import socket
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.begin import make_lock
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.restart import act_on
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options
from tests.unit.fakes.runner import fake_runner


@pytest.fixture
def manager() -> FakeManager:
    manager = FakeManager()
    manager.add(options())
    return manager


@pytest.mark.parametrize("action", ["stop", "restart"])
def test_a_dataflow(
    action: str, manager: FakeManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[bytes] = []
    monkeypatch.setattr(socket.socket, "sendto", lambda _, data, *__: notes.append(data))
    scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)
    (cell,) = read_cells(manager)
    done = act_on(manager, scope, cell, "", action, by="doractl top", on_stage=print)
    assert done.endswith(f"{UUID} (robot)")
    assert [call[0] for call in manager.calls if "Unit" in call[0]] == [f"{action.title()}Unit"]
    (note,) = notes
    assert b"stop-asked" in note
    assert b"(doractl top)" in note, "a restart stops it, too"


@pytest.mark.parametrize("action", ["stop", "restart"])
def test_what_needs_a_dataflow_ends_with_it(
    action: str, manager: FakeManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has chosen the one has asked for the end of both."""
    notes: list[bytes] = []
    monkeypatch.setattr(socket.socket, "sendto", lambda _, data, *__: notes.append(data))
    manager.add(options("arm", "660e8400-e29b-41d4-a716-446655440000"))
    manager.units["dora-robot.service"]["RequiredBy"] = ["dora-arm.service"]
    scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)
    (cell,) = [one for one in read_cells(manager) if one.name == "robot"]
    done = act_on(manager, scope, cell, "", action, by="doractl top")
    assert [one.rpartition(" ")[2] for one in done.split("; ")] == ["(robot)", "(arm)"]
    jobs = [call for call in manager.calls if "Unit" in call[0]]
    assert jobs == [(f"{action.title()}Unit", "dora-robot.service", "dora-arm.service")]
    assert [b"DORA_DATAFLOW_NAME=arm\n" in note for note in notes] == [False, True]
    assert all(b"(doractl top)" in note for note in notes)


def test_what_could_not_start_again_keeps_running(manager: FakeManager, tmp_path: Path) -> None:
    scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)
    (cell,) = read_cells(manager)
    refused = {"error": "b.py, line 1: invalid syntax", "hint": "", "code": 6}
    with (
        fake_runner(scope.cell_directory("robot"), refused=refused),
        pytest.raises(DoraSystemdError, match=r"^b\.py, line 1: invalid syntax$") as caught,
    ):
        act_on(manager, scope, cell, "", "restart", by="doractl top")
    assert caught.value.hint.startswith("robot keeps running; ")
    assert not [call for call in manager.calls if "dora-robot.service" in call]


@pytest.mark.parametrize("action", ["stop", "restart"])
def test_a_node_of_an_inhibited_dataflow(action: str, manager: FakeManager, tmp_path: Path) -> None:
    scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)
    (cell,) = read_cells(manager)
    (path := scope.cell_directory("robot") / "inhibit.lock").parent.mkdir(parents=True)
    make_lock(path)
    table = CellStatus(nodes={"camera": NodeStatus("running", 1)}).to_json()
    path.with_name("status.json").write_text(table)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        with pytest.raises(DoraSystemdError, match=f"cannot {action} node camera of robot: inh"):
            act_on(manager, scope, cell, "camera", action, by="doractl top")


def test_a_node_of_a_dataflow_whose_runner_is_gone(manager: FakeManager, tmp_path: Path) -> None:
    scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)
    (cell,) = read_cells(manager)
    with pytest.raises(DoraSystemdError):
        act_on(manager, scope, cell, "camera", "restart", by="doractl top")
    assert not manager.calls

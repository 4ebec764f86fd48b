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

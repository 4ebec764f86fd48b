"""What is asked of a coordinator, and who may ask."""

import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.options import SettingText
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.dora.protocol import Coordinator
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs import node
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.reload import reload_cell
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.fakes.runner import fake_runner


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path)


class FakeRunner:
    """Answers every request with `reply`, or raises it."""

    def __init__(self, reply: dict[str, Any] | DoraSystemdError) -> None:
        self.reply = reply
        self.requests: list[Mapping[str, Any]] = []

    def __call__(self, path: Path, request: Mapping[str, Any]) -> dict[str, Any]:
        assert path.name == "runner.sock"
        self.requests.append(request)
        if isinstance(self.reply, DoraSystemdError):
            raise self.reply
        return self.reply


STOP = node.NodeOrder("stop", "camera", "doractl node stop", 5)


@pytest.fixture
def cell(scope: Scope) -> Iterator[Cell]:
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    status = CellStatus(run="run-1", nodes={"camera": NodeStatus("running")})
    (directory / "status.json").write_text(status.to_json())
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(directory / "runner.sock"))
        one.listen()
        yield make_cell("active")


def make_cell(active: str) -> Cell:
    manager = FakeManager()
    manager.add(options(), active=active)
    return read_cells(manager)[0]


def test_who_asks_for_what(scope: Scope, cell: Cell) -> None:
    runner = FakeRunner({"done": ["Node stopping: camera"]})
    assert node.order_node(scope, cell, STOP, runner) == "Node stopping: camera"
    (request,) = runner.requests
    by = request.pop("by") if isinstance(request, dict) else ""
    assert by.endswith(" (doractl node stop)")
    assert request == {"verb": "node", "what": "stop", "node": "camera", "grace": 5}


def test_how_long_an_answer_may_take() -> None:
    """As long as the stop of a recorder, and longer."""
    manager = FakeManager()
    manager.add(options())
    usual = options()._replace(name="slow")
    manager.add(usual._replace(settings=(SettingText("recorder", "stop", "within=200s"),)))
    found = [node.patient(cell) for cell in read_cells(manager)]
    waits = [one.keywords["most"] for one in found if isinstance(one, partial)]
    assert waits == [165, 450]


def test_a_runner_with_another_protocol(scope: Scope, cell: Cell) -> None:
    table = scope.cell_directory("robot") / "status.json"
    status = CellStatus.from_json(table.read_text())
    table.write_text(status._replace(protocol=2).to_json())
    runner = FakeRunner({"done": []})
    with pytest.raises(DoraSystemdError, match="robot: it has protocol 2, and this") as caught:
        node.order_node(scope, cell, STOP, runner)
    assert caught.value.hint == "doractl restart robot starts the installed version"
    assert not runner.requests


def test_dora_node_stop(scope: Scope, cell: Cell) -> None:
    runner = FakeRunner({"done": ["Node stopping: camera"]})
    words = ["node", "stop", "camera", "-d", "robot"]
    assert node.order_like_dora(scope, cell, words, runner) == "Node `camera` stopped"
    (request,) = runner.requests
    assert str(request["by"]).endswith(" (doractl dora, dora node stop)")
    assert not node.order_like_dora(scope, cell, [*words[:-1], "other"], runner)
    assert not node.order_like_dora(scope, cell, ["node", "list"], runner)
    assert len(runner.requests) == 1


def test_unknown_node(scope: Scope, cell: Cell) -> None:
    with pytest.raises(DoraSystemdError, match="cannot find a node 'camer'") as caught:
        node.order_node(scope, cell, replace(STOP, node="camer"))
    assert caught.value.hint == "did you mean camera?"
    assert caught.value.code is ExitCode.NOT_FOUND


def test_who_may_not_read_the_table_is_refused_by_the_socket(scope: Scope, cell: Cell) -> None:
    (scope.cell_directory("robot") / "status.json").unlink()
    denied = FakeRunner(DoraSystemdError("permission denied", "", ExitCode.NO_PERMISSION))
    for door in (
        lambda: node.order_node(scope, cell, STOP, denied),
        lambda: reload_cell(scope, cell, "camera", denied),
    ):
        with pytest.raises(DoraSystemdError, match="permission denied") as caught:
            door()
        assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_refusal(scope: Scope, cell: Cell) -> None:
    hint, code = "doractl list NAME says what it does", ExitCode.NOT_RUNNING
    refusal = DoraSystemdError("cannot restart camera: it has ended", hint, code)
    with pytest.raises(DoraSystemdError, match="cannot restart camera") as caught:
        node.order_node(scope, cell, STOP, FakeRunner(refusal))
    assert (caught.value.hint, caught.value.code) == ("doractl list robot says what it does", code)


def test_dataflow_that_does_not_run(scope: Scope) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        node.read_coordinator(scope, make_cell("failed"))
    assert caught.value.code is ExitCode.NOT_RUNNING


def test_no_runner(scope: Scope, cell: Cell) -> None:
    (scope.cell_directory("robot") / "runner.sock").unlink()
    with pytest.raises(DoraSystemdError) as caught:
        node.order_node(scope, cell, STOP)
    assert caught.value.code is ExitCode.NOT_RUNNING


def test_an_odd_answer(scope: Scope, cell: Cell) -> None:
    with pytest.raises(DoraSystemdError, match="it answers something else than was asked"):
        node.order_node(scope, cell, STOP, FakeRunner({"done": [5]}))


def test_a_port_of_somebody_else(scope: Scope) -> None:
    """What the runner names is its user's to say: root gives no token to another's port."""
    with socket.create_server(("127.0.0.1", 0)) as other, ExitStack() as held:
        told = Coordinator(other.getsockname()[1], "secret", 4712)
        held.enter_context(fake_runner(scope.cell_directory("robot"), **told._asdict()))
        manager = FakeManager()
        manager.add(options())
        (cell,) = read_cells(manager)
        facts = manager.units[cell.unit]
        facts["UID"] = os.getuid() + 1
        with pytest.raises(DoraSystemdError, match="listens there, not") as caught:
            node.reached_coordinator(scope, manager, cell)
        assert caught.value.code is ExitCode.NO_PERMISSION
        facts["UID"] = 2**32 - 1
        assert node.reached_coordinator(scope, manager, cell) == told
        facts["PrivateNetwork"] = True
        with pytest.raises(DoraSystemdError, match="its network is private") as caught:
            node.reached_coordinator(scope, manager, cell)
        assert "dora robot -- ..." in caught.value.hint


def test_environment_of_the_dora_command() -> None:
    assert node.dora_environment(Coordinator(4711, "secret", 4712)) == {
        "DORA_COORDINATOR_ADDR": "127.0.0.1",
        "DORA_COORDINATOR_PORT": "4711",
        "DORA_AUTH_TOKEN": "secret",
        "DORA_DAEMON_LOCAL_LISTEN_PORT": "4712",
    }

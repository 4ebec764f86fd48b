"""What is asked of a coordinator, and who may ask."""

import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.dora.coordinator import Coordinator
from dora_systemd.decisions.dora.protocol import Params, Reply
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs import node
from dora_systemd.verbs.facts.cells import Cell, read_cells
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.fakes.runner import fake_runner


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path)


class FakeCoordinator:
    """Answers every request with `reply`, Info with a descriptor of one node."""

    def __init__(self, restart_policy: str | None) -> None:
        self.requests: list[Mapping[str, Any]] = []
        self.node: dict[str, Any] = {"id": "camera", "path": "x"}
        self.others = [{"id": "plot", "inputs": {"image": {"source": "camera/image"}}}]
        if restart_policy:
            self.node["restart_policy"] = restart_policy
        self.error = ""

    def __call__(self, scope: Scope, cell: Cell, params: Params) -> Reply:
        assert not isinstance(params, str)
        assert (scope.is_user, cell.name) == (True, "robot")
        self.requests.append(params)
        info = {"DataflowInfo": {"descriptor": {"nodes": [self.node, *self.others]}}}
        return Reply("", info if "Info" in params else {}, self.error)


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


@pytest.mark.parametrize(
    ("policy", "method"),
    [
        (None, "ReplaceNode"),
        ("never", "ReplaceNode"),
        ("on-failure", "RestartNode"),
        ("always", "RestartNode"),
    ],
)
def test_restart(scope: Scope, cell: Cell, policy: str | None, method: str) -> None:
    fake = FakeCoordinator(policy)
    node.restart_node(scope, cell, "camera", fake)
    ((asked, params),) = fake.requests[-1].items()
    assert asked == method
    assert params["dataflow_id"] == "run-1"


def test_restart_of_a_node_that_nobody_reads(scope: Scope, cell: Cell) -> None:
    fake = FakeCoordinator(None)
    fake.others = [{"id": "plot", "inputs": {"image": "camera2/image"}}]
    node.restart_node(scope, cell, "camera", fake)
    assert list(fake.requests[-1]) == ["RestartNode"]


def test_stop(scope: Scope, cell: Cell) -> None:
    fake = FakeCoordinator(None)
    node.stop_node(scope, cell, "camera", fake)
    assert fake.requests == [
        {"StopNode": {"dataflow_id": "run-1", "node_id": "camera", "grace_duration": None}}
    ]


def test_unknown_node(scope: Scope, cell: Cell) -> None:
    with pytest.raises(DoraSystemdError, match="cannot find a node 'camer'") as caught:
        node.stop_node(scope, cell, "camer")
    assert caught.value.hint == "did you mean camera?"
    assert caught.value.code is ExitCode.NOT_FOUND


def test_what_dora_refuses(scope: Scope, cell: Cell) -> None:
    fake = FakeCoordinator(None)
    fake.error = "not found in running dataflow"
    with pytest.raises(DoraSystemdError, match="not found in running dataflow"):
        node.stop_node(scope, cell, "camera", fake)


def test_dataflow_that_does_not_run(scope: Scope) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        node.read_coordinator(scope, make_cell("failed"))
    assert caught.value.code is ExitCode.NOT_RUNNING


def test_nothing_is_asked_of_what_is_no_runner(scope: Scope, cell: Cell) -> None:
    (scope.cell_directory("robot") / "runner.sock").unlink()
    fake = FakeCoordinator(None)
    with pytest.raises(DoraSystemdError) as caught:
        node.stop_node(scope, cell, "camera", fake)
    assert caught.value.code is ExitCode.NOT_RUNNING
    assert not fake.requests


@pytest.mark.parametrize(
    "info",
    [
        {},
        {"DataflowInfo": 5},
        {"DataflowInfo": {"descriptor": {"nodes": 5}}},
        {"DataflowInfo": {"descriptor": {"nodes": [5]}}},
    ],
)
def test_an_odd_answer(scope: Scope, cell: Cell, info: dict[str, Any]) -> None:
    with pytest.raises(DoraSystemdError, match="cannot understand dora's answer"):
        node.restart_node(scope, cell, "camera", lambda *_: Reply("", info, ""))


def test_words_of_dora_are_no_orders_for_a_terminal(scope: Scope, cell: Cell) -> None:
    fake = FakeCoordinator(None)
    fake.error = "no\x1b]0;title\x07\n\nLocation:\n    binaries/daemon/src/lib.rs:3:5"
    with pytest.raises(DoraSystemdError) as caught:
        node.stop_node(scope, cell, "camera", fake)
    assert caught.value.message.isprintable()
    assert "Location" not in caught.value.message


def test_a_port_of_somebody_else(scope: Scope) -> None:
    """What the runner names is its user's to say: root gives no token to another's port."""
    with socket.create_server(("127.0.0.1", 0)) as other, ExitStack() as held:
        told = Coordinator(other.getsockname()[1], "secret", 4712)
        held.enter_context(fake_runner(scope.cell_directory("robot"), **asdict(told)))
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

"""What goes to the coordinator of one dataflow: single nodes, and the stock dora command."""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from dora_systemd.busprotocol import Manager
from dora_systemd.cellpaths import CellPaths
from dora_systemd.doraenv import coordinator_variables
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.managercells import Cell, not_found
from dora_systemd.managerlist import read_status
from dora_systemd.protocol import Params, Reply, node_params, replace_params
from dora_systemd.reload import has_readers
from dora_systemd.scope import Scope
from dora_systemd.status import CellStatus
from dora_systemd.trust.programs import account_of_uid, become, fresh_environment
from dora_systemd.values import quoted

Ask = Callable[[Scope, Cell, Params], Reply]


@dataclass(frozen=True)
class Coordinator:
    """Where a cell's coordinator listens on 127.0.0.1, and the token that it asks for."""

    port: int
    token: str
    local_listen_port: int


def read_coordinator(scope: Scope, cell: Cell) -> Coordinator:
    """The coordinator of a running dataflow.

    Raises DoraSystemdError: NOT_RUNNING, or NO_PERMISSION when it is another user's.
    """
    require_running(cell)
    paths = CellPaths(scope.cell_directory(cell.name))
    try:
        raw = json.loads(paths.control.read_text())
        return Coordinator(raw["port"], raw["token"], raw["local_listen_port"])
    except PermissionError as error:
        raise DoraSystemdError(
            f"cannot speak to the dataflow {cell.name}: permission denied",
            "use sudo: only root and the user it runs as may",
            ExitCode.NO_PERMISSION,
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DoraSystemdError(
            f"cannot speak to the dataflow {cell.name}: its coordinator is not there",
            "it may be starting or stopping; see doractl list",
            ExitCode.NOT_RUNNING,
        ) from error


def require_running(cell: Cell) -> None:
    """Raise DoraSystemdError (NOT_RUNNING) unless the dataflow is up."""
    if not cell.is_up:
        raise DoraSystemdError(
            f"cannot use the dataflow {cell.name}: it is not running",
            f"doractl restart {cell.name}",
            ExitCode.NOT_RUNNING,
        )


def ask_coordinator(scope: Scope, cell: Cell, params: Params) -> Reply:
    """One request to the cell's coordinator, and its answer. Raises DoraSystemdError."""
    # WebSockets are slow to import, and no other verb needs them.
    from dora_systemd import control

    return control.request(CellPaths(scope.cell_directory(cell.name)).control, params)


def restart_node(scope: Scope, cell: Cell, node: str, ask: Ask = ask_coordinator) -> None:
    """End one node and start it again, while the others run on.

    dora's RestartNode ends every node downstream of one whose restart policy is "never". Such a
    node is replaced by a copy of itself, which nobody downstream notices; dora starts the copy
    before the old one ends, and does not tell that one to stop before its grace duration is over.
    """
    status = _checked_status(scope, cell, node)
    info = _answer(cell, ask(scope, cell, {"Info": {"dataflow_uuid": status.run}}))
    nodes: list[dict[str, Any]] = info["DataflowInfo"]["descriptor"]["nodes"]
    definition = next((one for one in nodes if one.get("id") == node), {})
    is_replaceable = definition.get("restart_policy", "never") == "never"
    if is_replaceable and has_readers(node, nodes):
        params = replace_params(status.run, definition)
    else:
        params = node_params("RestartNode", status.run, node)
    _answer(cell, ask(scope, cell, params))


def stop_node(scope: Scope, cell: Cell, node: str, ask: Ask = ask_coordinator) -> None:
    """End one node for good; its neighbours see their input closed."""
    status = _checked_status(scope, cell, node)
    _answer(cell, ask(scope, cell, node_params("StopNode", status.run, node)))


def exec_dora(scope: Scope, manager: Manager, cell: Cell, arguments: Sequence[str]) -> NoReturn:
    """Become the dora command, told to speak to the coordinator of this dataflow.

    Root runs it as the dataflow's user, who may have written it. Raises DoraSystemdError.
    """
    coordinator = read_coordinator(scope, cell)
    dora, environment = cell.options.dora, dict(os.environ)
    try:
        if os.geteuid() == 0 and not scope.is_user:
            account = account_of_uid(manager.read(cell.unit, ["UID"])["UID"])
            environment = {**fresh_environment(account), **_terminal()}
            become(account)
        os.execve(dora, [dora, *arguments], {**environment, **dora_environment(coordinator)})
    except OSError as error:
        raise DoraSystemdError(
            f"cannot run {dora}: {error.strerror}", "", ExitCode.NO_DORA
        ) from error


def _terminal() -> dict[str, str]:
    return {key: os.environ[key] for key in ("TERM", "NO_COLOR") if key in os.environ}


def dora_environment(coordinator: Coordinator) -> dict[str, str]:
    """The variables with which the dora command finds a coordinator and its daemon."""
    return coordinator_variables(coordinator.port, coordinator.token, coordinator.local_listen_port)


def _checked_status(scope: Scope, cell: Cell, node: str) -> CellStatus:
    read_coordinator(scope, cell)
    return require_node(scope, cell, node)


def require_node(scope: Scope, cell: Cell, node: str) -> CellStatus:
    """The live table that `node` is in. Raises DoraSystemdError (NOT_FOUND) if it is not."""
    status = read_status(scope, cell)
    if node not in status.nodes:
        raise DoraSystemdError(
            f"cannot find a node {quoted(node)} in the dataflow {cell.name}",
            not_found(node, list(status.nodes)).hint,
            ExitCode.NOT_FOUND,
        )
    return status


def _answer(cell: Cell, reply: Reply) -> dict[str, Any]:
    if reply.error:
        raise DoraSystemdError(
            f"cannot do that in the dataflow {cell.name}: {reply.error}",
            f"doractl restart {cell.name} starts all of it again",
        )
    return reply.result if isinstance(reply.result, dict) else {}

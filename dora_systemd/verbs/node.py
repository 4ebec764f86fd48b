"""Requests to the coordinator of one dataflow: for single nodes, and for the dora command."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import caller
from dora_systemd.adapters.runner_socket import client as runner_socket
from dora_systemd.adapters.runner_socket.client import done_of, order
from dora_systemd.decisions.cell.status import PROTOCOL
from dora_systemd.decisions.dora.command import coordinator_variables, parse_node_command
from dora_systemd.decisions.dora.protocol import Coordinator, Params, Reply
from dora_systemd.decisions.life.stop_budget import answer_timeout
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.paths import CellPaths
from dora_systemd.scope import Scope
from dora_systemd.trust.programs import Account, account_of_uid, become, fresh_environment
from dora_systemd.trust.sockets import require_listener
from dora_systemd.trust.terminals import run_apart
from dora_systemd.values import SECOND, quoted
from dora_systemd.verbs.facts.cells import CONTROL, Cell, refuse_parts, restart_due
from dora_systemd.verbs.facts.locks import IfInhibited, Tell, require_uninhibited
from dora_systemd.verbs.facts.reading import read_status

_NO_USER = 2**32 - 1
"""UID of a unit without User=: it runs as the manager's own user."""

Ask = Callable[[Path, Mapping[str, Any]], dict[str, Any]]


def read_coordinator(scope: Scope, cell: Cell) -> Coordinator:
    """The coordinator as the runner reports it; check it before connecting.

    Raises DoraSystemdError: NOT_RUNNING, or NO_PERMISSION for another user's dataflow.
    """
    require_running(cell)
    refuse_parts([cell], CONTROL)
    return runner_socket.ask_coordinator(socket_of(scope, cell))


def reached_coordinator(scope: Scope, manager: Manager, cell: Cell) -> Coordinator:
    """The coordinator, checked: only the dataflow's user listens on its port, in this network.

    Raises DoraSystemdError.
    """
    coordinator = read_coordinator(scope, cell)
    uid, is_private = _unit_facts(manager, cell)
    if is_private:
        raise usage_error(
            f"cannot reach the coordinator of {cell.name} by a port: its network is private",
            f"doractl {scope.flag} dora {cell.name} -- ..., or {scope.command} env for the gateway",
        )
    require_listener(coordinator.port, uid)
    return coordinator


def require_running(cell: Cell) -> None:
    """Raise DoraSystemdError (NOT_RUNNING) unless the dataflow is up."""
    if cell.state.is_held:
        raise DoraSystemdError(
            f"cannot use the dataflow {cell.name}: systemd has not started it yet",
            f"doractl list {cell.name} says what it waits for",
            ExitCode.NOT_RUNNING,
        )
    if not cell.is_up:
        raise DoraSystemdError(
            f"cannot use the dataflow {cell.name}: it is not running",
            f"doractl restart {cell.name}",
            ExitCode.NOT_RUNNING,
        )


def patient(cell: Cell) -> Ask:
    """What sends a request to the runner of `cell`, and waits as long as nodes may take to stop."""
    options = cell.options if cell.has_options else None
    return partial(order, most=answer_timeout(options) / SECOND) if options else order


def ask_coordinator(scope: Scope, cell: Cell, params: Params) -> Reply:
    """Send one request to the cell's coordinator; the reply. Raises DoraSystemdError."""
    # Imported late: WebSockets are slow to import, and no other verb needs them.
    from dora_systemd.adapters.dora import control

    return control.request(*runner_socket.relay(socket_of(scope, cell)), params)


@dataclass(frozen=True)
class NodeOrder:
    """A request for one node."""

    what: str  # RESTART or STOP of decisions/cell/status.py
    node: str
    by: str  # the command or page, such as "doractl node stop"
    grace: int | None = None  # µs that the node's process has to end; None: that of the dataflow


def order_node(
    scope: Scope,
    cell: Cell,
    given: NodeOrder,
    ask: Ask | None = None,
    how: IfInhibited = IfInhibited.REFUSE,
    tell: Tell | None = None,
) -> str:
    """Have the runner restart or stop one node; return the human-readable result.

    The runner records the requester, and uses none of the restarts that the node's policy allows.
    how, `tell`: as for uninhibited(). Raises DoraSystemdError, also while a lock inhibits it.
    """
    require_running(cell)
    refuse_parts([cell], CONTROL)
    require_node(scope, cell, given.node)
    require_uninhibited(scope, [cell], f"{given.what} node {given.node} of", how, tell)
    by = f"{caller(os.getuid(), os.environ)} ({given.by})"
    request = {"what": given.what, "node": given.node, "by": by, "grace": given.grace}
    path, ask = socket_of(scope, cell), ask or patient(cell)
    try:
        return "; ".join(done_of(path, ask(path, {"verb": "node", **request})))
    except DoraSystemdError as error:
        hint = error.hint.replace("NAME", cell.name)
        raise DoraSystemdError(error.message, hint, error.code) from error


def order_like_dora(
    scope: Scope, cell: Cell, arguments: Sequence[str], ask: Ask | None = None
) -> str:
    """Have the runner do what is a `dora node restart` or `stop`; what dora would print.

    "" for another command, and for one about another dataflow: they are dora's. Raises
    DoraSystemdError.
    """
    given = parse_node_command(arguments)
    if given is None or given.dataflow not in ("", cell.name):
        return ""
    door = f"doractl dora, dora node {given.what}"
    order_node(scope, cell, NodeOrder(given.what, given.node, door, given.grace), ask)
    return given.told


def exec_dora(scope: Scope, manager: Manager, cell: Cell, arguments: Sequence[str]) -> int:
    """Execute the dora command, connected to the coordinator of this dataflow.

    As root, it runs as the dataflow's user, who may have written it, on a separate terminal; then
    this returns its exit status. Raises DoraSystemdError.
    """
    uid, is_private = _unit_facts(manager, cell)
    account = account_of_uid(uid) if os.geteuid() == 0 and not scope.is_user else None
    if is_private:
        coordinator = _relayed(scope, cell, uid, account)
    else:
        coordinator = reached_coordinator(scope, manager, cell)
    command, found = [cell.options.dora, *arguments], dora_environment(coordinator)
    try:
        if account is not None:
            environment = {**fresh_environment(account), **_terminal(), **found}
            return run_apart(command, environment, account)
        os.execve(command[0], command, {**os.environ, **found})
    except OSError as error:
        raise DoraSystemdError(
            f"cannot run {command[0]}: {error.strerror}", "", ExitCode.NO_DORA
        ) from error


def _terminal() -> dict[str, str]:
    return {key: os.environ[key] for key in ("TERM", "NO_COLOR") if key in os.environ}


def _relayed(scope: Scope, cell: Cell, uid: int, account: Account | None) -> Coordinator:
    """A port that leads into the dataflow's private network as long as this process runs."""
    # Imported late: asyncio is slow to import, and only a private network needs it.
    from dora_systemd.adapters.runner_socket.relay import open_port

    coordinator = read_coordinator(scope, cell)
    port = open_port(socket_of(scope, cell), {uid, os.getuid()}, lambda: _settle(account))
    return coordinator._replace(port=port, local_listen_port=None)


def _unit_facts(manager: Manager, cell: Cell) -> tuple[int, bool]:
    """The uid of the unit, and whether it has a private network."""
    facts = manager.read(cell.unit, ["UID", "PrivateNetwork"])
    return os.getuid() if facts["UID"] == _NO_USER else facts["UID"], facts["PrivateNetwork"]


def socket_of(scope: Scope, cell: Cell) -> Path:
    """The socket of the runner of a dataflow.

    Raises DoraSystemdError for a runner whose answers this version does not know, and NOT_RUNNING
    while systemd waits before it starts the next one.
    """
    if cell.awaits_restart:
        raise restart_due(cell, f"cannot use the dataflow {cell.name}")
    protocol = read_status(scope, cell).protocol
    if protocol != PROTOCOL:
        reason = f"it has protocol {protocol}, and this doractl has protocol {PROTOCOL}"
        raise usage_error(
            f"cannot send a request to the runner of {cell.name}: {reason}",
            f"doractl restart {cell.name} starts the installed version",
        )
    return CellPaths(scope.cell_directory(cell.name)).socket


def _settle(account: Account | None) -> None:
    if account is not None:
        become(account)


def dora_environment(coordinator: Coordinator) -> dict[str, str]:
    """The variables by which the dora command finds a coordinator and its daemon."""
    return coordinator_variables(coordinator.port, coordinator.token, coordinator.local_listen_port)


def require_node(scope: Scope, cell: Cell, node: str) -> None:
    """Raise DoraSystemdError (NOT_FOUND) unless the dataflow has this node.

    Without a readable table the node is not checked: the runner's socket refuses another user, and
    the runner refuses an unknown node.
    """
    status = read_status(scope, cell)
    if status.nodes and node not in status.nodes:
        raise DoraSystemdError(
            f"cannot find a node {quoted(node)} in the dataflow {cell.name}",
            did_you_mean(node, status.nodes) or f"nodes: {', '.join(status.nodes)}",
            ExitCode.NOT_FOUND,
        )

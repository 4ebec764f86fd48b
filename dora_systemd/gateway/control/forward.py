"""Forwards requests that only a dataflow's coordinator can answer, and passes topics through.

A client of the gateway sees one UUID of a dataflow as long as the dataflow exists; in the cell each
run has its own UUID. Requests get the UUID of the run, answers that of the dataflow. Frames of
topics pass unchanged: they begin with the id of a subscription, which each coordinator chooses.
"""

import asyncio
from contextlib import closing, suppress
from typing import Any

from dora_systemd.adapters.dora.control import Connection
from dora_systemd.adapters.runner_socket.client import relay
from dora_systemd.decisions.cell.launch import PROGRAM_KEYS
from dora_systemd.decisions.cell.status import RESTART, STOP
from dora_systemd.decisions.dora.protocol import Params, Reply
from dora_systemd.decisions.gateway.answers import restored_descriptor
from dora_systemd.decisions.gateway.frames import Request, renamed
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.session import Result, Talk, find_by_uuid
from dora_systemd.gateway.control.state import ended_descriptor
from dora_systemd.scope import Scope
from dora_systemd.values import as_mapping
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.node import NodeOrder, order_node, require_running, socket_of
from dora_systemd.verbs.start.read import written_dataflow

_GOING_AWAY = 1001


async def forward(talk: Talk, request: Request) -> Result:
    """Send the request to the dataflow's own coordinator. Raises DoraSystemdError."""
    cell, run = await asyncio.to_thread(_running, talk.scope, request.dataflow)
    reply = await _ask(talk.scope, cell, renamed(request.params, cell.uuid, run))
    return _answer(reply, run, cell.uuid)


async def restart_one_node(talk: Talk, request: Request) -> Result:
    """RestartNode, by the runner. Raises DoraSystemdError."""
    return {"NodeRestarted": await _order(talk, request, RESTART)}


async def stop_one_node(talk: Talk, request: Request) -> Result:
    """StopNode, by the runner. Raises DoraSystemdError."""
    return {"NodeStopped": await _order(talk, request, STOP)}


async def _order(talk: Talk, request: Request, what: str) -> dict[str, str]:
    node = request.text("node_id")
    cell, _ = await asyncio.to_thread(_running, talk.scope, request.dataflow)
    given = NodeOrder(what, node, f"dora node {what}", request.grace)
    await asyncio.to_thread(order_node, talk.scope, cell, given)
    return {"dataflow_id": cell.uuid, "node_id": node}


async def describe(talk: Talk, request: Request) -> Result:
    """Info about a run, with the nodes' programs as written. Raises DoraSystemdError."""
    uuid = request.dataflow
    with suppress(DoraSystemdError):
        return await _describe_running(talk.scope, uuid)
    name, descriptor = await asyncio.to_thread(ended_descriptor, talk.scope, uuid)
    return {"DataflowInfo": {"uuid": uuid, "name": name, "descriptor": descriptor}}


async def _describe_running(scope: Scope, uuid: str) -> dict[str, Any]:
    cell, run = await asyncio.to_thread(_running, scope, uuid)
    reply = await _ask(scope, cell, {"Info": {"dataflow_uuid": run}})
    if reply.error or not isinstance(reply.result, dict):
        raise DoraSystemdError(reply.error or "cannot understand dora")
    running = reply.result["DataflowInfo"]["descriptor"]
    written = await asyncio.to_thread(written_dataflow, cell.options.dataflow)
    descriptor = restored_descriptor(running, [node.raw for node in written.nodes], PROGRAM_KEYS)
    return {"DataflowInfo": {"uuid": uuid, "name": cell.name, "descriptor": descriptor}}


async def subscribe_topics(talk: Talk, request: Request) -> Result:
    """TopicSubscribe, on its own connection to the dataflow. Raises DoraSystemdError."""
    cell, run = await asyncio.to_thread(_running, talk.scope, request.dataflow)
    connection = await _open(talk.scope, cell)
    try:
        reply = await connection.request(renamed(request.params, cell.uuid, run))
        ident = _subscription(reply)
        talk.after_reply(_pass_frames(talk, ident, connection))
    except BaseException:
        connection.close()
        raise
    talk.topics[ident] = connection
    return _answer(reply, run, cell.uuid)


def _subscription(reply: Reply) -> str:
    """The id of the new subscription. Raises DoraSystemdError with dora's message."""
    made = as_mapping(as_mapping(reply.result).get("TopicSubscribed")).get("subscription_id")
    if isinstance(made, str):
        return made
    raise DoraSystemdError(f"cannot subscribe: {reply.error or 'dora does not say why'}")


async def unsubscribe_topics(talk: Talk, request: Request) -> Result:
    """Answer TopicUnsubscribe."""
    ident = request.text("subscription_id")
    connection = talk.topics.pop(ident, None)
    if connection is None:
        raise DoraSystemdError("cannot unsubscribe: no such subscription", "", ExitCode.NOT_FOUND)
    connection.close()
    return {"unsubscribed": True, "subscription_id": ident}


async def _pass_frames(talk: Talk, ident: str, connection: Connection) -> None:
    with closing(connection):
        async for frame in connection.frames():
            await talk.socket.send(frame)
    if talk.topics.pop(ident, None) is not None:  # the dataflow has ended
        await talk.socket.close(_GOING_AWAY, "the dataflow has ended")


def _running(scope: Scope, uuid: str) -> tuple[Cell, str]:
    """A running dataflow, and dora's id of its run. Raises DoraSystemdError."""
    cell = find_by_uuid(scope, uuid)
    require_running(cell)
    run = read_status(scope, cell).run
    if run:
        return cell, run
    raise DoraSystemdError(
        f"cannot speak to the dataflow {cell.name}: it is starting or stopping",
        f"see doractl {scope.flag} list {cell.name}",
        ExitCode.NOT_RUNNING,
    )


async def _open(scope: Scope, cell: Cell) -> Connection:
    return await Connection.over(*await asyncio.to_thread(relay, socket_of(scope, cell)))


async def _ask(scope: Scope, cell: Cell, params: Params) -> Reply:
    with closing(await _open(scope, cell)) as connection:
        return await connection.request(params)


def _answer(reply: Reply, run: str, uuid: str) -> Result:
    if isinstance(reply.result, dict | str):
        answer: Result = renamed(reply.result, run, uuid)
        return answer
    return {"Error": str(renamed(reply.error, run, uuid)) or "dora gave no answer"}

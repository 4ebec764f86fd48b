"""/api/control of the gateway: dora's control protocol, for the dora command.

To the dora command it is one coordinator with all dataflows of a scope. The gateway answers from
systemd, the journal and the node tables where they suffice, and forwards other requests to the
coordinator of the dataflow. It refuses requests that would bypass the supervisor.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable

from dora_systemd.decisions.gateway.frames import (
    Malformed,
    Request,
    error_result,
    format_malformed,
    format_result,
    parse_request,
    refused_version,
)
from dora_systemd.decisions.gateway.request import Request as HttpRequest
from dora_systemd.decisions.gateway.request import Socket
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.control import forward as cell
from dora_systemd.gateway.control import jobs, logs, state
from dora_systemd.gateway.control.session import Result, Talk

log = logging.getLogger(__name__)

Handler = Callable[[Talk, Request], Awaitable[Result]]

Task = asyncio.Task[None]

_LOOPBACK = "127.0.0.1"
_AT_ONCE = 8
"""Requests of one connection that run in parallel."""
_LONGEST = 500
_BY_FILE = "edit its file, then run: doractl reload NAME"
_OWN = "doractl dora NAME -- trace list sends the request to the coordinator of one dataflow"


async def serve_control(socket: Socket, request: HttpRequest) -> None:
    """Serve one dora command until it disconnects; requests in progress still complete.

    Requests run in parallel, unlike in a coordinator: a start can take long, and only a further
    read shows that the command has disconnected.
    """
    talk, pending = Talk(socket, request.scope), set[Task]()
    try:
        async for message in socket:
            task = asyncio.ensure_future(_answer(talk, message))
            pending.add(task)
            task.add_done_callback(_forget)
            task.add_done_callback(pending.discard)
            if len(pending) >= _AT_ONCE:
                await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await talk.end()
        await asyncio.gather(*pending, return_exceptions=True)


def _forget(task: Task) -> None:
    """Take the error of a closed connection: there is nowhere to report it."""
    if not task.cancelled():
        task.exception()


async def _answer(talk: Talk, message: str | bytes) -> None:
    request = parse_request(message)
    if isinstance(request, Malformed):
        await talk.socket.send(format_malformed(request))
        return
    result = await _result(talk, request)
    if result is not None:
        await talk.socket.send(format_result(request.id, result))
    talk.begin_tasks()


async def _result(talk: Talk, request: Request) -> Result:
    if request.name in REFUSED:
        return error_result(DoraSystemdError(*REFUSED[request.name]))
    handler = HANDLERS.get(request.name)
    if handler is None:
        return error_result(DoraSystemdError(f"unknown request {request.name[:80]}"))
    try:
        return await handler(talk, request)
    except DoraSystemdError as error:
        return error_result(error)
    except Exception as error:
        # No check covers all wrong requests; without a reply the dora command would wait forever.
        log.info("cannot answer %s: %s: %s", request.name, type(error).__name__, error)
        return error_result(DoraSystemdError(f"cannot do {request.name}: {error}"[:_LONGEST]))


async def _hello(_talk: Talk, request: Request) -> Result:
    refusal = refused_version(request.body.get("dora_version"))
    return {"Error": refusal} if refusal else {"HelloOk": dict(request.body)}


async def _same_machine(_talk: Talk, _request: Request) -> Result:
    return {"CliAndDefaultDaemonIps": {"default_daemon": _LOOPBACK, "cli": _LOOPBACK}}


async def _daemon_connected(_talk: Talk, _request: Request) -> Result:
    return {"DaemonConnected": True}  # systemd starts a daemon for each dataflow


HANDLERS: dict[str, Handler] = {
    "Hello": _hello,
    "CliAndDefaultDaemonOnSameMachine": _same_machine,
    "DaemonConnected": _daemon_connected,
    "ConnectedMachines": lambda talk, _: asyncio.to_thread(state.list_daemons, talk.scope),
    "List": lambda talk, _: asyncio.to_thread(state.list_dataflows, talk.scope),
    "GetNodeInfo": lambda talk, _: asyncio.to_thread(state.list_nodes, talk.scope),
    "Check": logs.check,
    "Info": cell.describe,
    "Start": jobs.start,
    "WaitForSpawn": jobs.wait_for_spawn,
    **dict.fromkeys(("Stop", "StopByName"), jobs.stop),
    **dict.fromkeys(("Restart", "RestartByName"), jobs.restart),
    "Logs": logs.send_logs,
    "LogSubscribe": logs.subscribe_logs,
    "RestartNode": cell.restart_one_node,
    "StopNode": cell.stop_one_node,
    "TopicSubscribe": cell.subscribe_topics,
    "TopicUnsubscribe": cell.unsubscribe_topics,
    **dict.fromkeys(
        (
            *("Reload", "TopicPublish"),
            *("GetParams", "GetParam", "SetParam", "DeleteParam"),
        ),
        cell.forward,
    ),
}

REFUSED: dict[str, tuple[str, str]] = {
    "Destroy": (
        "cannot take dora down: systemd runs the dataflows, and the gateway only shows them",
        "doractl destroy stops all of them, doractl stop NAME one",
    ),
    "Clean": (
        "cannot clean: ended dataflows are known from the journal, which journald cleans up",
        "systemctl reset-failed 'dora-*' clears the failed ones",
    ),
    **dict.fromkeys(
        ("Build", "WaitForBuild", "BuildLogSubscribe"),
        ("cannot build through the gateway", "doractl build FILE, then start it"),
    ),
    **dict.fromkeys(
        ("GetTraces", "GetTraceSpans"),
        ("cannot show traces of all dataflows", _OWN),
    ),
    **dict.fromkeys(
        ("AddNode", "RemoveNode", "ReplaceNode", "AddMapping", "RemoveMapping"),
        ("cannot change a supervised dataflow except through its file", _BY_FILE),
    ),
}
"""Message and hint for requests that the gateway does not support."""

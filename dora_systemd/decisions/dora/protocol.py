"""dora's control protocol as its client uses it: frames to values and back. No socket, no clock.

The frames are those of dora 1.0 and 1.1 on `/api/control`; dora's docs/websocket-control-plane.md
documents some of them. The runner writes and reports the address and token of its coordinator.
"""

import json
import re
from collections.abc import Mapping
from itertools import takewhile
from math import isfinite
from typing import Any, NamedTuple
from uuid import uuid4

from dora_systemd.decisions.cell.exits import Exit, ExitKind
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import INFINITY, SECOND, as_list, as_mapping

_TOKEN_TEXT = r"[0-9A-Za-z._~+/=-]{1,512}"
"""The characters of a token in an HTTP header: RFC 6750, section 2.1."""


class Coordinator(NamedTuple):
    """Ports of 127.0.0.1 and a token."""

    # port, token: of the coordinator
    port: int
    token: str
    # the daemon's port for dynamic nodes; None if they cannot reach it
    local_listen_port: int | None

    def raw(self) -> dict[str, Any]:
        """The values for JSON; parse_coordinator reads them."""
        return self._asdict()


def parse_coordinator(raw: object) -> Coordinator:
    """Parse the address of a coordinator. Raises ValueError if it is not valid."""
    if not isinstance(raw, dict):
        raise ValueError("not an object")
    port, listen = (_port(raw.get(key)) for key in ("port", "local_listen_port"))
    return Coordinator(port, parse_token(raw.get("token")), listen)


def parse_token(raw: object) -> str:
    """Parse the token of a coordinator. Raises ValueError if it is not valid."""
    if not isinstance(raw, str) or not re.fullmatch(_TOKEN_TEXT, raw):
        raise ValueError("not a token")
    return raw


def _port(raw: object) -> int:
    if type(raw) is not int or not 0 < raw < 65536:
        raise ValueError("not a port")
    return raw


Params = str | Mapping[str, Any]

_BEHIND_ERROR = r"\s*(?:Location|Stack backtrace|Suggestion)\b"
_ENDED_ALREADY = r"unknown dataflow\b"


class Reply(NamedTuple):
    """The reply to request `id`."""

    id: str
    result: Any  # that of a good reply
    error: str  # "" or dora's text


class LogRecord(NamedTuple):
    """One line of dora's event stream."""

    level: str
    target: str
    node: str  # "" if it is about the whole dataflow
    message: str


def encode_request(params: Params) -> tuple[str, str]:
    """The id and the text frame of a request."""
    ident = str(uuid4())
    return ident, json.dumps({"id": ident, "method": "control", "params": params})


MOST_FRAME = 8 * 1024 * 1024
"""Maximum length of a frame that is parsed, which takes up to 20 times as much memory. A frame of
dora has at most one descriptor, of 1 MiB, with escapes."""


def parse_frame(text: str | bytes) -> Reply | LogRecord | None:
    """A frame of the coordinator; None if it is not relevant, or longer than any of dora."""
    if len(text) > MOST_FRAME:
        return None
    try:
        frame = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(frame, dict):
        return None
    if frame.get("event") == "log" and isinstance(frame.get("payload"), dict):
        return _log_record(frame["payload"])
    if isinstance(frame.get("id"), str):
        return _reply(frame)
    return None


def _log_record(payload: Mapping[str, Any]) -> LogRecord:
    texts = {key: str(payload.get(key) or "") for key in ("level", "target", "node_id", "message")}
    return LogRecord(texts["level"].upper(), texts["target"], texts["node_id"], texts["message"])


def _reply(frame: Mapping[str, Any]) -> Reply:
    # A malformed request gets "error", one that failed gets {"result": {"Error": ...}}.
    result, error = frame.get("result"), frame.get("error")
    if isinstance(result, dict) and "Error" in result:
        error = result["Error"]
    words = error if isinstance(error, str) else "an error without words"
    return Reply(frame["id"], result, "" if error is None else words)


def result_of(reply: Reply, key: str) -> Any:
    """The value of `key` in a good reply.

    Raises DoraSystemdError for an error, and for a reply of another kind.
    """
    if reply.error:
        raise DoraSystemdError(f"cannot do this in dora: {first_line(reply.error)}")
    if not isinstance(reply.result, dict) or key not in reply.result:
        raise DoraSystemdError(
            f"cannot understand dora: {key} expected, got {str(reply.result)[:80]}",
            "dora-systemd speaks with dora 1.0 and 1.1; see `doractl version`",
        )
    return reply.result[key]


def start_params(descriptor: Mapping[str, Any], name: str, work: str) -> Params:
    """Start a run. work: absolute directory of dora's `out/`, and the nodes' default directory."""
    return {
        "Start": {
            "build_id": None,
            "session_id": str(uuid4()),
            "dataflow": descriptor,
            "name": name,
            "local_working_dir": work,
            "uv": False,
            "write_events_to": None,
        }
    }


def stop_params(run: str, grace: int) -> Params:
    """Stop a run. grace: µs until dora sends SIGTERM; SIGKILL follows after 1.5 times that."""
    return {"Stop": {"dataflow_uuid": run, "grace_duration": duration(grace), "force": False}}


def duration(microseconds: int) -> Mapping[str, int]:
    """Microseconds as a Duration of Rust's serde."""
    seconds, rest = divmod(microseconds, SECOND)
    return {"secs": seconds, "nanos": rest * 1000}


def subscribe_params(run: str) -> Params:
    """Subscribe to the life events of a run. `spawned node with pid` has the level Debug."""
    return {"LogSubscribe": {"dataflow_id": run, "level": "Debug"}}


_UNSUBSCRIBED = "all daemons running this dataflow disconnected"


def ends_subscription(record: LogRecord) -> bool:
    """Whether the coordinator sends no more records after this one.

    The coordinator forgets a run and its subscribers when all daemons of the run have disconnected,
    as after a freeze of 20 s. The connection to the subscriber stays open. When a daemon has
    connected again, the coordinator accepts a new subscription.
    """
    is_own = record.target == "coordinator" and not record.node
    return is_own and record.message.startswith(_UNSUBSCRIBED)


def wait_spawn_params(run: str) -> Params:
    """Wait until dora has executed all nodes; the reply may be why it could not execute one."""
    return {"WaitForSpawn": {"dataflow_id": run}}


def check_params(run: str) -> Params:
    """Query whether the run has ended, and how."""
    return {"Check": {"dataflow_uuid": run}}


def node_params(method: str, run: str, node: str, grace: int | None = None) -> Params:
    """RestartNode, StopNode or RemoveNode. grace: µs as for stop_params; None: dora's default."""
    limit = None if grace is None else duration(grace)
    return {method: {"dataflow_id": run, "node_id": node, "grace_duration": limit}}


OVERLAP = SECOND
"""µs for which a node and its replacement run in parallel, at most."""


def replace_params(run: str, definition: Mapping[str, Any]) -> Params:
    """Start `definition` in place of the node with that id, which then has OVERLAP µs to exit."""
    overlap = duration(OVERLAP)
    return {"ReplaceNode": {"dataflow_id": run, "node": definition, "grace_duration": overlap}}


NO_NODE = "no running node"
"""In dora's refusal of ReplaceNode for a node that it has given up."""


def add_params(run: str, definition: Mapping[str, Any]) -> Params:
    """Add a node to a running dataflow."""
    return {"AddNode": {"dataflow_id": run, "node": definition}}


def reload_params(run: str, node: str, operator: str) -> Params:
    """Have a Python operator load its file again."""
    return {"Reload": {"dataflow_id": run, "node_id": node, "operator_id": operator}}


DAEMON_CONNECTED: Params = "DaemonConnected"
CONNECTED_DAEMONS: Params = "ConnectedMachines"


def parse_heartbeat(reply: Reply) -> int:
    """µs since the last heartbeat of this machine's daemon, from the reply to CONNECTED_DAEMONS.

    Of several machines this is the head. INFINITY if its daemon is not connected, 0 if the reply
    does not contain the time.
    """
    if not isinstance(as_mapping(reply.result).get("ConnectedDaemons"), list):
        return 0
    return min((age for machine, age in parse_heartbeats(reply) if not machine), default=INFINITY)


def parse_heartbeats(reply: Reply) -> list[tuple[str, int]]:
    """The machine of each daemon in the reply to CONNECTED_DAEMONS, and µs since its heartbeat.

    "" is a machine without a name. 0 stands for a daemon whose time the reply does not contain. A
    machine that has reconnected can occur twice.
    """
    daemons = as_list(as_mapping(reply.result).get("ConnectedDaemons"))
    return [(_machine_of(one), _silence_of(one)) for one in map(as_mapping, daemons)]


def _machine_of(daemon: Mapping[str, Any]) -> str:
    return str(as_mapping(daemon.get("daemon_id")).get("machine_id") or "")


def _silence_of(daemon: Mapping[str, Any]) -> int:
    age = daemon.get("last_heartbeat_ago_ms")
    return int(age * 1000) if isinstance(age, int | float) and isfinite(age) else 0


def parse_results(reply: Reply) -> dict[str, Exit] | None:
    """The reply to Check or Stop: None during the run, else how each node ended.

    An empty mapping means that dora does not know, and never success: a coordinator without its
    daemon replies like that.
    """
    result = as_mapping(reply.result)
    if "DataflowSpawned" in result:
        return None
    nodes = as_mapping(
        as_mapping(as_mapping(result.get("DataflowStopped")).get("result")).get("node_results")
    )
    return {node: _failure(verdict) for node, verdict in sorted(nodes.items())}


def parse_spawn_failure(reply: Reply) -> str:
    """The reply to WaitForSpawn: "", or why a node could not be executed.

    A run that dora no longer knows was executed and has ended: its life events report how.
    """
    return "" if re.match(_ENDED_ALREADY, reply.error) else first_line(reply.error)


def _failure(verdict: Any) -> Exit:
    if "Err" not in as_mapping(verdict):
        return Exit()
    error = as_mapping(verdict["Err"])
    cause = as_mapping(error.get("cause"))
    if "FailedToSpawn" in cause:
        return Exit(words=f"failed to spawn: {first_line(str(cause['FailedToSpawn']))}")
    ended = exit_value(*next(iter(as_mapping(error.get("exit_status")).items()), ("", None)))
    if "Cascading" in cause:
        return ended._replace(by=str(as_mapping(cause["Cascading"]).get("caused_by_node")))
    if error.get("cause") == "GraceDuration":
        return ended._replace(words=f"{ended.words} after the grace duration")
    return ended


def exit_value(kind: str, number: Any) -> Exit:
    """An exit status as dora writes it; kind: ExitCode, Signal or a word without a number."""
    kinds = {"ExitCode": ExitKind.CODE, "Signal": ExitKind.SIGNAL}
    if kind in kinds and isinstance(number, int):
        return Exit(kinds[kind], number)
    return Exit() if kind == "Success" else Exit(words="unknown exit status")


def first_line(text: str) -> str:
    """An error of dora without the location and backtrace after it."""
    # Line by line: nodes can have a coordinator of their own, which sends a million line ends.
    first, *rest = text.split("\n")
    head = takewhile(lambda line: not re.match(_BEHIND_ERROR, line), rest)
    return " ".join(" ".join((first, *head)).split())

"""Formats facts from systemd, the journal and the node tables as answers of dora. Pure.

The formats are those of dora's coordinator 1.1.0: sizes in MB of 1,000,000 bytes, four states of
nodes, times of results as 64-bit NTP timestamps.
"""

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.exits import ExitKind, find_exit
from dora_systemd.decisions.cell.extra import without_extra
from dora_systemd.decisions.logs.records import (
    DORA_LEVELS,
    Record,
    level_of,
    record_text,
    timestamp,
)
from dora_systemd.decisions.views.dataflows import FAILED, UP_WORDS
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.values import SECOND

_MEGABYTE = 1_000_000
_NTP_BITS = 32
_NODE_STATES = {
    **{"failed": "failed", "finished": "stopped", "stopped": "stopped"},
    **{"restarting": "restarting", "reloading": "restarting"},
    "waiting": "restarting",
}
_EXITS = {ExitKind.CODE: "ExitCode", ExitKind.SIGNAL: "Signal"}
_SYSTEMD_FIELDS = ("UNIT", "USER_UNIT")


def dataflow_list(rows: Iterable[DataflowRow]) -> dict[str, Any]:
    """The reply to List."""
    return {
        "DataflowList": [
            {"id": {"uuid": row.uuid, "name": row.name}, "status": _status(row.status)}
            for row in rows
        ]
    }


def _status(word: str) -> str:
    if word in UP_WORDS:
        return "Running"
    return "Failed" if word == FAILED else "Finished"


def node_list(rows: Iterable[DataflowRow]) -> dict[str, Any]:
    """The reply to GetNodeInfo."""
    return {"NodeInfoList": [_node_info(row, node) for row in rows for node in row.nodes]}


def _node_info(row: DataflowRow, node: NodeRow) -> dict[str, Any]:
    return {
        "dataflow_id": row.uuid,
        "dataflow_name": row.name,
        "node_id": node.node,
        "daemon_id": _daemon_id(row.uuid),
        "metrics": {
            "pid": node.pid,
            "cpu_usage": node.cpu_percent or 0.0,
            "memory_mb": (node.memory or 0) / _MEGABYTE,
            "disk_read_mb_s": None,
            "disk_write_mb_s": None,
            "restart_count": node.restarts or 0,
            "broken_inputs": [],
            "status": _NODE_STATES.get(node.state, "running"),
            "pending_messages": 0,
        },
        "network": None,
    }


def daemon_list(uuids: Iterable[str]) -> dict[str, Any]:
    """The reply to ConnectedMachines: each dataflow has its own daemon."""
    daemons = [{"daemon_id": _daemon_id(one), "last_heartbeat_ago_ms": 0} for one in uuids]
    return {"ConnectedDaemons": daemons}


def _daemon_id(uuid: str) -> dict[str, Any]:
    return {"machine_id": None, "uuid": uuid}


def stopped(uuid: str, at_us: int, failures: Mapping[str, str]) -> dict[str, Any]:
    """DataflowStopped. at_us: CLOCK_REALTIME µs. failures: node -> how it failed."""
    stamp = {"time": _ntp(at_us), "id": list(bytes.fromhex(uuid.replace("-", "")))}
    results = {
        node: {
            "Err": {
                "timestamp": stamp,
                "cause": {"Other": {"stderr": text}},
                "exit_status": _exit_status(text),
            }
        }
        for node, text in failures.items()
    }
    result = {"uuid": uuid, "timestamp": stamp, "node_results": results}
    return {"DataflowStopped": {"uuid": uuid, "result": result}}


def _ntp(at_us: int) -> int:
    seconds, rest = divmod(at_us, SECOND)
    return seconds << _NTP_BITS | (rest << _NTP_BITS) // SECOND


def _exit_status(text: str) -> Any:
    exit = find_exit(text)
    return {_EXITS[exit.kind]: exit.number} if exit.kind in _EXITS else "Unknown"


def bare_descriptor(nodes: Iterable[str]) -> dict[str, Any]:
    """A descriptor with nodes only, which is all that is known after the unit is gone."""
    return {"nodes": [{"id": node, "path": ""} for node in nodes]}


def restored_descriptor(
    running: Mapping[str, Any], written: Sequence[Mapping[str, Any]], keys: Sequence[str]
) -> dict[str, Any]:
    """The descriptor of a run without added nodes, and each node's `keys` as its file has them.

    For nodes from a module's file, the program is the one that our launcher gets: an absolute path.
    """
    by_id = {node.get("id"): node for node in written}
    own = without_extra(running["nodes"])
    nodes = [_restored(node, by_id.get(node.get("id"), {}), keys) for node in own]
    return {**running, "nodes": nodes}


def _restored(
    node: Mapping[str, Any], written: Mapping[str, Any], keys: Sequence[str]
) -> dict[str, Any]:
    if not written:
        return {**node, **_program(node)}
    kept = {key: value for key, value in node.items() if key not in keys}
    return {**kept, **{key: written[key] for key in keys if key in written}}


def _program(node: Mapping[str, Any]) -> dict[str, str]:
    """Path and arguments of a node, from the arguments of our launcher; {} for any other node."""
    try:
        launcher, *words = shlex.split(str(node.get("args")))
    except ValueError:
        return {}
    command = words[5:] if words[3:5] == ["uv", "run"] else words[3:]
    if not launcher.endswith("/launcher.pl") or not command:
        return {}
    if command[0] == "sh" and command[1:2] == ["-c"]:
        return {"path": "shell", "args": " ".join(command[2:])}
    start = 1 + command.index("-u") if "-u" in command else 0
    # A program may have an argument "-u" as well as Python.
    start = start if command[start : start + 1] and command[start].endswith(".py") else 0
    return {"path": command[start], "args": shlex.join(command[start + 1 :])}


def log_line(record: Record) -> bytes:
    """A line of a node as in dora's log file log_<node>.jsonl, except for empty keys."""
    line = {
        "ts": timestamp(record),
        "level": level_of(record),
        "node": record_text(record, "DORA_NODE"),
        "msg": record_text(record, "MESSAGE"),
    }
    if "DORA_TARGET" in record:
        line["target"] = record_text(record, "DORA_TARGET")
    return json.dumps(line, separators=(",", ":")).encode() + b"\n"


def is_wanted(record: Record, level: object) -> bool:
    """Whether a subscriber at `level`, a name of dora's, gets the record; plain lines always."""
    own, asked = level_of(record), str(level).lower()
    if own == "stdout" or asked not in DORA_LEVELS:
        return True
    return DORA_LEVELS.index(own) <= DORA_LEVELS.index(asked)


def is_from_systemd(record: Record) -> bool:
    """Whether the record is systemd's, about the end of the unit."""
    return any(name in record for name in _SYSTEMD_FIELDS)

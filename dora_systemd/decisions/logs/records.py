"""Records of the journal as messages of dora's log stream, and which of them to show. Pure."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from typing import Any

from dora_systemd.decisions.cell.machines import Placed, members_of
from dora_systemd.errors import usage_error
from dora_systemd.terminal_text import shown_log
from dora_systemd.values import format_moment, quoted

Record = Mapping[str, bytes]
"""An entry of the journal in the export format."""

LOG_FIELDS = (
    *("MESSAGE", "PRIORITY", "MESSAGE_ID", "UNIT", "USER_UNIT"),
    *("DORA_NODE", "DORA_LEVEL", "DORA_TARGET", "DORA_STREAM"),
)
"""The fields that these functions, and is_from_systemd() of the gateway, use."""

_OWN_TARGET = "dora-systemd"
DORA_LEVELS = ("off", "error", "warn", "info", "debug", "trace")
"""The levels of dora; raw lines of nodes are `stdout`."""
_BY_PRIORITY = {
    **dict.fromkeys((b"0", b"1", b"2", b"3"), "error"),
    **{b"4": "warn", b"7": "debug"},
}


class DoraLines:
    """Formats records as `dora run` does with --log-format json or compact.

    uuid: of the dataflow. is_terminal: escape control characters.
    """

    def __init__(self, form: str, uuid: str, is_terminal: bool) -> None:
        self._form = _compact if form == "compact" else partial(json.dumps, separators=(",", ":"))
        self._uuid = uuid
        self._is_terminal = is_terminal

    def record(self, record: Record) -> bytes:
        line = self._form(log_payload(record, self._uuid)).encode()
        return (shown_log(line) if self._is_terminal else line) + b"\n"


def _compact(payload: Mapping[str, Any]) -> str:
    when = datetime.fromisoformat(payload["timestamp"]).astimezone()
    node = payload["node_id"] or "dora"
    return f"{when:%H:%M:%S} {payload['level'].upper()} {node}: {payload['message']}"


def log_payload(record: Record, uuid: str) -> dict[str, Any]:
    """A record of the journal as an event of dora's log stream. uuid: of the dataflow."""
    level = level_of(record)
    target = record_text(record, "DORA_TARGET") or ("" if "DORA_STREAM" in record else _OWN_TARGET)
    return {
        "build_id": None,
        "dataflow_id": uuid,
        "node_id": record_text(record, "DORA_NODE") or None,
        "daemon_id": None,
        "level": level if level == "stdout" else level.upper(),
        "target": target or None,
        "module_path": None,
        "file": None,
        "line": None,
        "message": record_text(record, "MESSAGE"),
        "timestamp": timestamp(record),
        "fields": None,
    }


def level_of(record: Record) -> str:
    """Return the level of a record: one of DORA_LEVELS, or "stdout" for a raw line of a node."""
    level = record_text(record, "DORA_LEVEL")
    if level in DORA_LEVELS:
        return level
    if "DORA_STREAM" in record:
        return "stdout"
    return _BY_PRIORITY.get(record.get("PRIORITY", b""), "info")


def record_text(record: Record, name: str) -> str:
    """The field `name` of the record as text, "" without it."""
    return record.get(name, b"").decode("utf-8", "replace")


def timestamp(record: Record) -> str:
    """Format when journald received a record, as in RFC 3339, in UTC."""
    return format_moment(int(record.get("__REALTIME_TIMESTAMP", b"0")))


RAW = "stdout"
"""The level that shows everything, also raw lines of nodes, which have no level."""
FILTER_LEVELS = (*DORA_LEVELS[1:], RAW)


@dataclass(frozen=True)
class LogFilter:
    """The levels to show."""

    level: str = RAW  # of all records but those of `nodes`
    nodes: Mapping[str, str] = field(default_factory=dict)  # the levels of single nodes by id

    def shows(self, record: Record) -> bool:
        """Whether to show the record: raw lines only at the level "stdout", as in dora."""
        asked = self.nodes.get(record_text(record, "DORA_NODE"), self.level)
        own = level_of(record)
        return asked == RAW or own in DORA_LEVELS[: DORA_LEVELS.index(asked) + 1]


def parse_filter(text: str) -> dict[str, str]:
    """The level of each node in "NODE=LEVEL,...". Raises DoraSystemdError (USAGE)."""
    return dict(_parsed(pair) for one in text.split(",") if (pair := one.strip()))


def _parsed(pair: str) -> tuple[str, str]:
    node, _, level = (part.strip() for part in pair.partition("="))
    level = level.lower()
    if not node or level not in FILTER_LEVELS:
        hint = f"write NODE=LEVEL,...; levels: {', '.join(FILTER_LEVELS)}"
        raise usage_error(f"cannot read {quoted(pair)} as a log filter", hint)
    return node, level


_NOTICE = b"5"


def lines_elsewhere(name: str, placed: Sequence[Placed], node: str, at_us: int) -> list[Record]:
    """Return a record that names other machines with lines of a dataflow or a node; [] for none.

    The gateway cannot read those lines: it has no keys, and its unit no network. node: "" for all.
    at_us: now, CLOCK_REALTIME.
    """
    away = [one for one in placed if node in ("", one.node)]
    if not away:
        return []
    machines = members_of(away)
    where = f"machine {machines[0]}" if len(machines) == 1 else f"machines {', '.join(machines)}"
    which = f" --node {node}" if node else ""
    text = f"more lines are in the journal of {where}: doractl logs {name}{which}"
    return [
        {
            "__REALTIME_TIMESTAMP": b"%d" % at_us,
            "MESSAGE": text.encode(),
            "PRIORITY": _NOTICE,
            **({"DORA_NODE": node.encode()} if node else {}),
        }
    ]

"""The live table of one cell: the runner writes it to status.json, and `list` reads it. Pure.

NodeAsked of life/events.py records a requested restart or stop of a node before dora carries it
out. The table keeps the request: code that counts, shows or judges an end calls was_asked() or
is_stopped().
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from dora_systemd import __version__
from dora_systemd.decisions.cell.exits import Exit, parse_exit
from dora_systemd.decisions.resources.usage import WHOLE_CELL, CpuSample, LineCount
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_name, is_node_id

Value = TypeVar("Value")

UNMET = "unmet"
"""Stage of a dataflow with a node that waits for what it needs."""
GATHERING = "gathering"
"""Stage of a dataflow that waits for another machine."""
STAGES = (
    "starting",
    "restarting",
    "waiting",
    UNMET,
    GATHERING,
    "running",
    "degraded",
    "stopping",
    "ended",
)
NODE_STATES = (
    "starting",
    "waiting",
    "ready",
    "running",
    "restarting",
    "reloading",
    "finished",
    "failed",
    "stopped",
    "dynamic",
)
FAILED_BECAUSE = "failed: "
"""Prefix of STATUS= for the reason why a dataflow failed."""
HELD = "held"
"""Policy of a node that waits for a reload after it has failed."""
LATCHED = "latched"
"""Policy of a node without restarts that dora starts once more, only to give it up."""
_WITH_PROCESS = ("starting", "ready", "running", "reloading")
ALIVE_NODE_STATES = frozenset({"ready", "running", "dynamic"})

MAX_NODES = 2000
"""Maximum nodes of a valid table."""
_MAX_SAMPLES = 8
_MAX_TEXT = 1000
"""Maximum characters of a text; the rest is cut."""
_MAX_NUMBER = 2**63 - 1
_MAX_TIME = 253_370_764_800_000_000
"""The year 9999, CLOCK_REALTIME in µs: the last year that a date can have."""
_VERSION = r"[0-9][0-9A-Za-z.+~-]{0,39}"
_UNREADABLE = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError)


class NodeStatus(NamedTuple):
    """One node as the runner sees it."""

    state: str = "starting"  # one of NODE_STATES
    pid: int = 0  # 0 if no process is known
    restarts: int = 0  # number of restarts by dora in this run
    since_us: int = 0  # CLOCK_REALTIME µs of the last change of state
    exit: Exit = Exit()  # how its last process ended
    # how dora starts it (python, executable, shell, uv, operator, ros2, dynamic, url)
    kind: str = ""
    policy: str = "never"  # dora's restart policy, "never" if it has none, HELD or LATCHED
    max_restarts: int = 0  # in one window, 0 without limit
    hung: str = ""  # why dora's health check or its watchdog ended the process, or ""
    silent: str = ""  # which output that it owes has not come, or ""
    is_ended: bool = False  # the runner ends the node because it is silent
    needs: str = ""  # what it waits for, or ""
    machine: str = ""  # the name of the other machine that it runs on, or ""
    asked: str = ""  # RESTART or STOP, if that was requested, or ""
    asked_by: str = ""  # who requested it
    # whether dora only has a launcher of the node, which waits because a stop was requested
    is_held: bool = False

    @property
    def is_alive(self) -> bool:
        """Whether it counts as alive in "2/3 nodes"."""
        return self.state in ALIVE_NODE_STATES

    @property
    def may_run(self) -> bool:
        """Whether its program may run. The head of several machines knows no pid of others."""
        return bool(self.pid) or self.state in _WITH_PROCESS


PROTOCOL = 1
"""Of the requests to a runner and its answers. It changes when a runner would carry out a request
of another version in another way; a request that is only new has its own error."""
_FIRST_PROTOCOL = 1
"""Of tables without one."""


class CellStatus(NamedTuple):
    """The content of status.json."""

    uuid: str = ""
    run: str = ""  # dora's own id of this run, or ""
    stage: str = "starting"  # one of STAGES
    text: str = ""  # the unit's STATUS=
    # started_us, ready_us: CLOCK_REALTIME µs, 0 if that has not happened
    started_us: int = 0
    ready_us: int = 0
    nodes: Mapping[str, NodeStatus] = {}
    samples: tuple[CpuSample, ...] = ()  # the last SAMPLES_KEPT CPU samples, oldest first
    lines: Mapping[str, LineCount] = {}  # by node; lost ones count for WHOLE_CELL
    up_us: int = 0  # CLOCK_MONOTONIC µs of READY=1, 0 before it
    is_first: bool = False  # whether NRestarts= of the unit is certainly 0
    # of nodes with a notify socket, for parse_sign() of dora_systemd.decisions.watchdog.messages
    signs: Mapping[str, tuple[Any, ...]] = {}
    # of nodes that stop: CLOCK_MONOTONIC µs at which their time is over
    stop_dues: Mapping[str, int] = {}
    # of nodes on other machines, for parse_use() of dora_systemd.decisions.machines.usage
    usage: Mapping[str, Sequence[Any]] = {}
    version: str = __version__  # of the dora-systemd that wrote it, or "" of a version before
    protocol: int = PROTOCOL  # of its runner

    @property
    def alive_count(self) -> int:
        """Number of nodes that are alive, including dynamic ones."""
        return sum(node.is_alive for node in self.nodes.values())

    def to_json(self) -> str:
        """The text of status.json."""
        values = self._asdict()
        values["nodes"] = {
            key: {**node._asdict(), "exit": str(node.exit)} for key, node in self.nodes.items()
        }
        values["samples"] = [
            {**one._asdict(), "cpu_us": {**one.cpu_us}, "throttling": {**one.throttling}}
            for one in self.samples
        ]
        values["lines"] = {**self.lines}
        values["stop_dues"] = {**self.stop_dues}
        values["usage"] = {**self.usage}
        return json.dumps(values)

    @classmethod
    def from_json(cls, text: str | bytes) -> "CellStatus":
        """Inverse of to_json, for a text that the nodes' user could have written.

        Ignores unknown keys, because the runner may be a newer version. Raises DoraSystemdError for
        everything that no runner writes.
        """
        try:
            return _parse_cell(json.loads(text, parse_constant=_refuse_constant))
        except _UNREADABLE as error:
            raise DoraSystemdError(
                f"cannot read the node table of a dataflow: {_reason(error)}",
                "it was written by another version of dora-systemd, or damaged",
                ExitCode.FAILURE,
            ) from error


class _Wrong(ValueError):
    """An error in a table, with a text for users; other exceptions have Python's text."""


def _reason(error: Exception) -> str:
    if isinstance(error, _Wrong):
        return str(error)
    return "it is nested too deeply" if isinstance(error, RecursionError) else "it is not JSON"


def _refuse_constant(name: str) -> float:
    raise _Wrong(f"{name} is not a number")


def _parse_cell(raw: Any) -> CellStatus:
    known = _object(raw, "the table")
    nodes = _by_node(known.get("nodes", {}), _parse_node)
    if WHOLE_CELL in nodes:
        raise _Wrong("it has a node without an id")
    samples = known.get("samples", [])
    if not isinstance(samples, list) or len(samples) > _MAX_SAMPLES:
        raise _Wrong("its samples are not a short list")
    return CellStatus(
        uuid=_text(known, "uuid"),
        run=_text(known, "run"),
        stage=_word(known, "stage", STAGES),
        text=_text(known, "text"),
        started_us=_number(known, "started_us", _MAX_TIME),
        ready_us=_number(known, "ready_us", _MAX_TIME),
        nodes=nodes,
        samples=tuple(map(_parse_sample, samples)),
        lines=_by_node(known.get("lines", {}), lambda one: LineCount(*_numbers(one, 3))),
        up_us=_number(known, "up_us"),
        is_first=known.get("is_first") is True,
        signs=_by_node(known.get("signs", {}), tuple),
        stop_dues=_by_node(known.get("stop_dues", {}), lambda one: _numbers([one], 1)[0]),
        usage=_by_node(known.get("usage", {}), tuple),
        version=_version(known),
        protocol=_number({"protocol": _FIRST_PROTOCOL, **known}, "protocol"),
    )


def _parse_node(raw: Any) -> NodeStatus:
    known = _object(raw, "a node")
    return NodeStatus(
        state=_word(known, "state", NODE_STATES),
        pid=_number(known, "pid"),
        restarts=_number(known, "restarts"),
        since_us=_number(known, "since_us", _MAX_TIME),
        exit=parse_exit(_text(known, "exit")),
        kind=_text(known, "kind"),
        policy=_text(known, "policy", "never"),
        max_restarts=_number(known, "max_restarts"),
        hung=_text(known, "hung"),
        silent=_text(known, "silent"),
        is_ended=known.get("is_ended") is True,
        needs=_text(known, "needs"),
        machine=_machine(known),
        asked=_text(known, "asked"),
        asked_by=_text(known, "asked_by"),
        is_held=known.get("is_held") is True,
    )


def _machine(raw: Mapping[str, Any]) -> str:
    name = _text(raw, "machine")
    if name and not is_name(name):
        raise _Wrong("it has a machine without a name")
    return name


def _version(raw: Mapping[str, Any]) -> str:
    text = _text(raw, "version")
    if text and not re.fullmatch(_VERSION, text):
        raise _Wrong("its version is none")
    return text


def _parse_sample(raw: Any) -> CpuSample:
    known = _object(raw, "a sample")
    if "at_us" not in known:
        raise _Wrong("a sample has no time")
    return CpuSample(
        _number(known, "at_us"),
        _by_node(known.get("cpu_us", {}), lambda one: _numbers([one], 1)[0]),
        _by_node(known.get("throttling", {}), lambda pair: _pair(_numbers(pair, 2))),
    )


def _object(raw: Any, what: str) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise _Wrong(f"{what} is not an object")
    return raw


def _by_node(raw: Any, parse: Callable[[Any], Value]) -> dict[str, Value]:
    given = _object(raw, "what is kept by node")
    if not given:
        return {}
    if len(given) > MAX_NODES + 1:
        raise _Wrong(f"it has more than {MAX_NODES} nodes")
    if any(key != WHOLE_CELL and not is_node_id(key) for key in given):
        raise _Wrong("it has a node whose id dora would refuse")
    return {key: parse(value) for key, value in given.items()}


def _text(raw: Mapping[str, Any], key: str, default: str = "") -> str:
    value = raw.get(key, default)
    if not isinstance(value, str):
        raise _Wrong(f"its {key} is not a text")
    return value[:_MAX_TEXT]


def _word(raw: Mapping[str, Any], key: str, words: Sequence[str]) -> str:
    value = raw.get(key, words[0])
    if value not in words:
        raise _Wrong(f"its {key} is unknown")
    return str(value)


def _number(raw: Mapping[str, Any], key: str, most: int = _MAX_NUMBER) -> int:
    return _checked(raw.get(key, 0), most)


def _numbers(raw: Any, count: int) -> list[int]:
    if not isinstance(raw, list) or len(raw) != count:
        raise _Wrong(f"it has no {count} numbers where it should")
    return [_checked(one, _MAX_NUMBER) for one in raw]


def _pair(numbers: list[int]) -> tuple[int, int]:
    return numbers[0], numbers[1]


def _checked(value: Any, most: int) -> int:
    if type(value) is not int or not 0 <= value <= most:
        raise _Wrong("it has a number that cannot be")
    return value


RESTART, STOP = "restart", "stop"


def was_asked(node: NodeStatus) -> bool:
    """Return whether an end of the node's process was requested.

    A restart covers the process that it ends, and not the next process, which can crash.
    """
    return is_stopped(node) or (node.asked == RESTART and node.state == "reloading")


def is_stopped(node: NodeStatus) -> bool:
    """Return whether the node was stopped by a request, and not started again."""
    return node.asked == STOP


def is_stopping(node: NodeStatus) -> bool:
    """Return whether a stopped node still has a process, other than its launcher."""
    return is_stopped(node) and bool(node.pid) and not node.is_held


def format_stopped(stopped: Mapping[str, str]) -> str:
    """Format "plot, requested by root (doractl node stop)"; "" if no node was stopped.

    stopped: for each node the user and command that requested its stop, or "".
    """
    by = dict.fromkeys(filter(None, stopped.values()))
    parts = (
        (", ".join(node for node, one in stopped.items() if one == who), format_asked(who))
        for who in by
    )
    return "; ".join(f"{nodes}, {asked}" for nodes, asked in parts)


def format_asked(by: str) -> str:
    """Format the user and command of a request: "requested by root (doractl node stop)"."""
    return f"requested by {by}"

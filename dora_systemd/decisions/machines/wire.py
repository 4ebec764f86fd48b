"""The messages between head and member: lines of JSON through one ssh. Pure.

    head's runner == link ==ssh== doractl member == member's runner

The link sends a Link to the runner of the head, and receives Forwards. Then the link only passes
lines. The first line to a member is a Part; after that each side sends a Beat every second. A side
that receives nothing for LEASE ends its part of the dataflow. Head and member do not trust each
other: lines and texts are bounded, and every value has a type.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

from dora_systemd.decisions.cell.machines import HEAD, parse_machine
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import parse_name, parse_uuid

VERSION = 1
BEAT_SECONDS = 1.0
LEASE_SECONDS = 7.0
"""TCP sends again up to 6.2 s after a gap has begun, and ssh gives up later: this alone counts.
"""
MAX_LINE = 1 << 18
"""Bytes of a line, with its end."""
MAX_TEXT = 1000
"""Characters of a text that people read; the rest is cut."""
LOWEST_PORT, HIGHEST_PORT = 1024, 65535
PORT_RANGE = range(61000, 61200)
"""Where the head chooses ports that have to be free on all machines: outside of Linux's ephemeral
ports, see ip_local_port_range in ip(7). The key of a machine names each of them."""


@dataclass(frozen=True)
class Forwards:
    """Runner of the head to link: ports of 127.0.0.1 that ssh makes the same on both machines."""

    coordinator: int  # the head listens on it
    # by machine, HEAD for the head; each machine listens on its own port. None if the machines
    # reach each other without ssh.
    zenoh: Mapping[str, int]


@dataclass(frozen=True)
class Lost:
    """Link to the runner of the head: ssh has ended."""

    words: str  # its last line, or why there is none


@dataclass(frozen=True)
class Unreached:
    """Link to the runner of the head: no doractl runs there as a member."""

    reason: str
    hint: str
    tries: int  # failed attempts in a row after which a start by hand gives up; 0: all give up


@dataclass(frozen=True)
class Taken:
    """Link to the runner of the head: one of its ports cannot be forwarded."""

    reason: str
    hint: str


@dataclass(frozen=True)
class Part:
    """Head to member: what it shall run. The settings come from the command line of `member`."""

    # name, uuid: of the dataflow
    name: str
    uuid: str
    machine: str  # the name of the member
    # token, coordinator: of the coordinator
    token: str
    coordinator: int
    zenoh: int  # where its daemon listens
    digest: str  # SHA-256 of the descriptor, hex
    grace: int  # µs
    # doractl, dora: versions of the head
    doractl: str
    dora: str
    again: int = 0  # 0 for a start by hand; else what is missing may appear later
    version: int = VERSION


@dataclass(frozen=True)
class Beat:
    """Either side still runs."""


@dataclass(frozen=True)
class Ready:
    """Member to head: its daemon has joined."""

    work: str  # its directory for dora, absolute


@dataclass(frozen=True)
class Table:
    """Member to head: its live table, as CellStatus.to_json()."""

    status: str


@dataclass(frozen=True)
class Programs:
    """Member to head: the digests of what its nodes run, see decisions/machines/part.py."""

    digests: str


@dataclass(frozen=True)
class Hung:
    """Member to head: a node there is about to be ended."""

    node: str
    reason: str
    record: str  # the life event, see NodeHung
    pid: int = 0  # of its process there, 0 if that is not known


@dataclass(frozen=True)
class Refused:
    """Member to head: it runs nothing, and a restart does not help."""

    reason: str
    hint: str = ""


@dataclass(frozen=True)
class Ended:
    """Member to head: its part has ended or is about to."""

    reason: str = ""  # one line, "" if all went well
    by: str = ""  # who requested the end, or ""
    # 1 if its part has failed by itself; 0 also if its machine shuts down, or it has lost the head
    failed: int = 0
    waits: int = 0  # 1 if its nodes run until the head stops them in their order, for a moment


@dataclass(frozen=True)
class Run:
    """Head to member: the head has started a run, and receives its events."""

    run: str  # dora's id of it


@dataclass(frozen=True)
class StopPart:
    """Head to member: end your nodes within `grace` µs, without a request to dora."""

    grace: int


@dataclass(frozen=True)
class Stopping:
    """Head to member: the head is about to have dora stop all nodes."""

    by: str = ""  # who requested that
    limit: int = 0  # as of HeadStops


@dataclass(frozen=True)
class StopNode:
    """Head to member: in the order of a stop it is the turn of a node there."""

    node: str
    within: int  # µs until SIGTERM
    most: int  # µs until SIGTERM if the node extends its time


RUNNER_ENDED = "its supervisor process has ended"
"""The reason in a Lost from the relay of a member whose runner has ended without reporting why."""


@dataclass(frozen=True)
class Asked:
    """Head to member: a restart or stop of one of the member's nodes was requested, or refused."""

    node: str
    what: str  # RESTART or STOP, or "" if dora has refused that
    by: str  # who requested that, or why dora has refused it


@dataclass(frozen=True)
class Check:
    """Head to member: could your part start again? digest: SHA-256 of the descriptor now, hex."""

    digest: str


@dataclass(frozen=True)
class Checked:
    """Member to head: the answer to a Check."""

    reason: str = ""  # why its part could not start again, or ""
    hint: str = ""


FromLink = Lost | Unreached | Taken
Message = (
    Forwards
    | FromLink
    | Part
    | Beat
    | Ready
    | Table
    | Programs
    | Hung
    | Refused
    | Ended
    | Run
    | StopPart
    | Stopping
    | StopNode
    | Asked
    | Check
    | Checked
)
M = TypeVar("M", bound=Message)

_TYPES: Mapping[str, type[Any]] = {
    "forwards": Forwards,
    "lost": Lost,
    "unreached": Unreached,
    "taken": Taken,
    "part": Part,
    "beat": Beat,
    "ready": Ready,
    "table": Table,
    "programs": Programs,
    "hung": Hung,
    "refused": Refused,
    "ended": Ended,
    "run": Run,
    "stop": StopPart,
    "stopping": Stopping,
    "stop-node": StopNode,
    "asked": Asked,
    "check": Check,
    "checked": Checked,
}
_NAMES = {kind: name for name, kind in _TYPES.items()}
_NUMBERS = {
    *("coordinator", "zenoh", "grace", "again", "version", "tries"),
    *("failed", "waits", "limit", "within", "most", "pid"),
}
_LONG = {"status", "digests"}
_BY_MACHINE = {(Forwards, "zenoh")}


def format_message(message: Message) -> bytes:
    """One line."""
    told = {"type": _NAMES[type(message)], **asdict(message)}
    return json.dumps(told).encode() + b"\n"


def parse_message(line: bytes) -> Message:
    """The message in a line. Raises DoraSystemdError (FAILURE)."""
    try:
        found = json.loads(line)
        kind = _TYPES[found.pop("type")]
        names = {one.name for one in fields(kind)}
        values = {key: _value(kind, key, one) for key, one in found.items() if key in names}
        return _checked(kind(**values))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise _unreadable() from error


def expect(message: Message, kind: type[M]) -> M:
    """The message if it is of that kind. Raises DoraSystemdError (FAILURE)."""
    if not isinstance(message, kind):
        raise _unreadable()
    return message


def _value(kind: type[Any], key: str, value: object) -> object:
    if (kind, key) in _BY_MACHINE and isinstance(value, dict):
        return {_machine(name): _number(one) for name, one in value.items()}
    if key in _NUMBERS:
        return _number(value)
    if not isinstance(value, str) or "\0" in value:
        raise ValueError(key)
    value.encode()  # JSON can contain half of a surrogate pair, which has no encoding
    return value if key in _LONG else value[:MAX_TEXT]


def _machine(text: str) -> str:
    return text if text == HEAD else parse_machine(text)


def _number(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**64:
        raise ValueError(value)
    return value


def _checked(message: Any) -> Message:
    if isinstance(message, Part):
        parse_name(message.name), parse_uuid(message.uuid), parse_machine(message.machine)
        _check_ports(message.coordinator, message.zenoh)
    if isinstance(message, Run):
        parse_uuid(message.run)
    if isinstance(message, Forwards):
        _check_ports(message.coordinator, *message.zenoh.values())
    return message  # type: ignore[no-any-return]


def _check_ports(*ports: int) -> None:
    if not all(LOWEST_PORT <= port <= HIGHEST_PORT for port in ports):
        raise ValueError("port")


def _unreadable() -> DoraSystemdError:
    hint = "both machines need the same version of dora-systemd"
    return DoraSystemdError("cannot read what the other machine says", hint, ExitCode.FAILURE)

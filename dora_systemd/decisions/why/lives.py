"""Groups journal records into lives of one dataflow: our life events, and systemd's records.

Records are journalctl's JSON; each field may be missing, or have any value. One life is one
invocation of the unit, see INVOCATION_ID in systemd.journal-fields(7). After its end the nodes are
known from its events only: the runner's table is gone.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.cell.status import STOP
from dora_systemd.decisions.logs.journal_events import REQUESTS
from dora_systemd.decisions.logs.query import (
    PROCESS_EXITED,
    UNIT_FAILED,
    UNIT_RESTART,
    UNIT_STARTING,
    UNIT_STOPPING,
)
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.names import is_node_id

# https://github.com/systemd/systemd/blob/main/src/systemd/sd-messages.h
UNIT_MESSAGES = {
    UNIT_STARTING: "unit-starting",
    "39f53479d3a045ac8e11786248231fbf": "unit-started",
    UNIT_STOPPING: "unit-stopping",
    "9d1aaa27d60140bd96365438aad20286": "unit-stopped",
    "7ad2d189f7e94e70a38c781354912448": "unit-succeeded",
    UNIT_FAILED: "unit-failed",
    PROCESS_EXITED: "process-exited",
    UNIT_RESTART: "unit-restart",
    "fe6faa94e7774663a0da52717891d8ef": "unit-oom",
}
"""systemd's own records about a unit: SD_MESSAGE_UNIT_* by MESSAGE_ID."""

SHUTDOWN_MESSAGE = "98268866d1d54a499c4e98921d93bc40"
"""SD_MESSAGE_SHUTDOWN, by systemd-logind."""

START_LIMIT_FUNCTION = "unit_test_start_limit"
"""CODE_FUNC of systemd's "Start request repeated too quickly.", which has no MESSAGE_ID."""

_MAX_TEXT = 4000
"""Maximum characters of a field: a node may have written it."""
_BEGINNINGS = ("unit-starting", "dataflow-starting")
_SYSTEMD_FIELDS = ("EXIT_CODE", "EXIT_STATUS", "COMMAND", "UNIT_RESULT", "N_RESTARTS")


@dataclass(frozen=True)
class Happening:
    """One record."""

    name: str  # DORA_EVENT, or one of UNIT_MESSAGES
    at_us: int = 0  # CLOCK_REALTIME µs
    node: str = ""
    text: str = ""
    invocation: str = ""
    boot: str = ""
    # DORA_* without that prefix, and systemd's own fields, in lower case
    details: Mapping[str, str] = field(default_factory=dict)

    def detail(self, key: str) -> str:
        """A detail, "" if it is not recorded."""
        return self.details.get(key, "")


@dataclass(frozen=True)
class Life:
    """One invocation of the unit, as far as it is recorded; oldest record first."""

    happenings: tuple[Happening, ...] = ()

    def all(self, *names: str) -> list[Happening]:
        """The records with these names."""
        return [one for one in self.happenings if one.name in names]

    def last(self, *names: str) -> Happening | None:
        """The last record with one of these names."""
        return next(reversed(self.all(*names)), None)

    def first(self, *names: str) -> Happening | None:
        """The first record with one of these names."""
        return next(iter(self.all(*names)), None)

    def is_of(self, uuid: str) -> bool:
        """Whether a record names the dataflow with that UUID."""
        return any(one.detail("dataflow") == uuid for one in self.happenings)

    @property
    def began_us(self) -> int:
        """CLOCK_REALTIME µs of its beginning, 0 if that is not recorded."""
        begin = self.first(*_BEGINNINGS)
        return begin.at_us if begin else 0

    @property
    def boot(self) -> str:
        """The id of the boot in which it ended, or ""."""
        return next((one.boot for one in reversed(self.happenings) if one.boot), "")

    @property
    def invocation(self) -> str:
        """systemd's invocation id, or ""."""
        return next((one.invocation for one in self.happenings if one.invocation), "")


def plain_text(value: Any) -> str:
    """The value of a journal field: bytes are a list of numbers, a repeated field is a list."""
    if isinstance(value, list):
        if value and all(isinstance(one, int) and 0 <= one < 256 for one in value):
            return bytes(value).decode("utf-8", "replace")
        return plain_text(value[-1]) if value else ""
    return "" if value is None else str(value)


def parse_happening(record: Mapping[str, Any]) -> Happening | None:
    """The happening of a record, or None if the record is about something else."""
    texts = {str(key): plain_text(value)[:_MAX_TEXT] for key, value in record.items()}
    name = texts.get("DORA_EVENT") or UNIT_MESSAGES.get(texts.get("MESSAGE_ID", ""), "")
    if texts.get("CODE_FUNC") == START_LIMIT_FUNCTION:
        name = "start-limit"
    if not name:
        return None
    own = {k[5:].lower(): text for k, text in texts.items() if k.startswith("DORA_")}
    own |= {key: _node_ids(own[key]) for key in ("node", "nodes") if key in own}
    systemd = {key.lower(): texts[key] for key in _SYSTEMD_FIELDS if key in texts}
    keys = ("_SYSTEMD_INVOCATION_ID", "INVOCATION_ID", "USER_INVOCATION_ID")
    ids = keys if "DORA_EVENT" in texts else keys[1:]
    return Happening(
        name,
        parse_number(texts.get("__REALTIME_TIMESTAMP", "")) or 0,
        own.get("node", ""),
        texts.get("MESSAGE", ""),
        next((texts[key] for key in ids if texts.get(key)), ""),
        texts.get("_BOOT_ID", ""),
        {**systemd, **own},
    )


def _node_ids(text: str) -> str:
    """The valid ids of nodes in a field: a remedy names them in commands."""
    return " ".join(filter(is_node_id, text.split()))


def parse_number(text: str) -> int | None:
    """The number in a field; None for another text."""
    return int(text) if text.isascii() and text.isdigit() else None


def find_lives(happenings: Iterable[Happening]) -> list[Life]:
    """The lives in happenings, oldest first; those without an invocation belong to the last one."""
    found: dict[str, list[Happening]] = {}
    current = ""
    for one in happenings:
        if one.invocation and one.name not in REQUESTS:
            current = one.invocation
        found.setdefault(current, []).append(one)
    return [Life(tuple(life)) for life in found.values()]


def lives_until(lives: Sequence[Life], at_us: int) -> list[Life]:
    """The lives up to the record of that time; all for 0, and if no record has that time."""
    places = [
        (number, place)
        for number, life in enumerate(lives)
        for place, one in enumerate(life.happenings)
        if at_us and one.at_us == at_us
    ]
    if not places:
        return list(lives)
    number, place = places[-1]
    return [*lives[:number], Life(lives[number].happenings[: place + 1])]


def with_restarts(lives: Sequence[Life]) -> list[Life]:
    """The last life, and those before it that led to it by automatic restarts of systemd."""
    chain = list(lives[-1:])
    for life in reversed(lives[:-1]):
        if life.last("unit-restart") is None:
            break
        chain.insert(0, life)
    return chain


_STATES = {
    "node-ready": "running",
    "node-restarted": "starting",
    "node-crashed": "failed",
    "node-ended": "failed",
    "node-oom": "failed",
    "node-exited": "finished",
    "node-asked": "stopped",
}
_WITH_PROCESS = ("running", "starting")


def ended_nodes(life: Life) -> tuple[NodeRow, ...]:
    """The nodes that the events of a life name, in the states in which its end left them."""
    rows: dict[str, NodeRow] = {}
    is_stopping = False
    for one in life.happenings:
        is_stopping |= one.name == "dataflow-stopping"
        is_news = one.name != "node-asked" or one.detail("asked") == STOP
        if one.node and one.name in _STATES and is_news:
            row = rows.get(one.node, NodeRow(one.node, "", restarts=0))
            rows[one.node] = _after(row, one, is_stopping)
    end = life.last("dataflow-failed")
    # Nodes that never became ready, or that ended with another node, have no event of their own.
    for node in end.detail("nodes").split() if end else ():
        rows[node] = rows.get(node, NodeRow(node, "", restarts=0))._replace(state="failed")
    return tuple(_closed(row, life) for row in rows.values())


def _after(row: NodeRow, event: Happening, is_stopping: bool) -> NodeRow:
    state, is_end = _STATES[event.name], event.name == "node-exited"
    return row._replace(
        state="stopped" if is_end and (is_stopping or event.detail("asked") == STOP) else state,
        restarts=(row.restarts or 0) + (event.name == "node-restarted"),
        exit=row.exit if state in _WITH_PROCESS else event.detail("exit"),
        since=event.at_us,
    )


def _closed(row: NodeRow, life: Life) -> NodeRow:
    """systemd leaves no process behind, whatever the last event of the node was."""
    if row.state not in _WITH_PROCESS:
        return row
    return row._replace(state="stopped", since=life.happenings[-1].at_us)

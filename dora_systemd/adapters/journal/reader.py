"""Queries of the journal, within limits: every node can write to it."""

import json
import os
import select
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, islice, takewhile
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from dora_systemd.adapters.journal.journalctl import (
    CHUNK,
    JOIN,
    end_journalctl,
    journal_output,
    open_journalctl,
)
from dora_systemd.decisions.cell.exits import KILLED
from dora_systemd.decisions.logs.journal_events import NODE_END_EVENTS
from dora_systemd.decisions.logs.query import (
    failure_matches,
    journal_timestamp,
    scope_matches,
    start_matches,
)
from dora_systemd.decisions.views.findings import Place
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_name, is_node_id, is_uuid, name_from_unit, unit_name
from dora_systemd.scope import Scope, without_systemd

_MOST_BEHIND, _AGAIN = 2.0, 0.1
"""Seconds that journald may take on a busy machine to write a record, and between two reads."""

T = TypeVar("T")

ROOT = Path("/")
"""The directory with all files of the machine."""
_PERSISTENT = "var/log/journal"
_VOLATILE = "run/log/journal"
_PLACES = {_VOLATILE: Place.MEMORY, _PERSISTENT: Place.DISK}

_LIFE_EVENTS = ("starting", "started", "stopping", "finished", "stopped", "failed")
_NAME_FIELDS = ("DORA_DATAFLOW", "DORA_DATAFLOW_NAME", "_SYSTEMD_UNIT", "_SYSTEMD_USER_UNIT")
_LIFE_FIELDS = ("DORA_DATAFLOW", "DORA_EVENT", "DORA_EXIT", "DORA_REASON")
_EVENT_FIELDS = (*_NAME_FIELDS, *_LIFE_FIELDS[1:])

MAX_LINE = 1024 * 1024
"""Maximum bytes of a record, or of a value."""
_MOST_FORGED = 100
_MOST_DOUBTED = 20
_MOST_NAMES = 1000
_MOST_DETAIL = 300
_MOST_RECORDS = 1000


@dataclass(frozen=True)
class LastEvent:
    """The last life event of a dataflow in the journal."""

    name: str
    uuid: str
    # such as "dataflow-failed"; a "dataflow-started" of a dataflow that systemd has unloaded means
    # that its runner was killed, or that the machine lost power
    event: str
    at_us: int  # CLOCK_REALTIME, µs
    detail: str  # exit status or reason, or ""
    cursor: str = ""  # its place in the journal


class Bounds(NamedTuple):
    """The limits of one call."""

    size: int = 32 * 1024 * 1024  # maximum bytes
    # timeout for the first record: journalctl may have to open large files on a slow disk
    first_seconds: float = 20.0
    seconds: float = 2.0  # timeout after the first record


_BOUNDS = Bounds()


class JournalReader:
    """Queries of the journal."""

    def __init__(self, bounds: Bounds = _BOUNDS) -> None:
        self._bounds = bounds
        self.is_cut = False  # whether the bounds have ended the last newest()

    def unique(self, field: str) -> list[str]:
        """Return all values of `field` in the journal, sorted."""
        lines = _lines([f"--field={field}", "--quiet"], self._bounds)
        return sorted(line.decode("utf-8", "replace").rstrip("\n") for line in lines)

    def known_names(self, scope: Scope) -> list[str]:
        """The names of all dataflows of `scope` with a record, sorted."""
        field = "_SYSTEMD_USER_UNIT" if scope.is_user else "_SYSTEMD_UNIT"
        found = filter(None, map(name_from_unit, self.unique(field)))
        if not scope.is_user:
            return list(found)  # only root can make such a unit
        starts = self.newest([*scope_matches(scope), "DORA_EVENT=dataflow-starting"], _MOST_NAMES)
        known = set(filter(None, map(_trusted_name, starts)))
        return self._recorded(known, found, lambda name: scope_matches(scope, name))

    def known_uuids(self) -> list[str]:
        """The UUIDs in all records, sorted: anybody can write more, see name_of()."""
        return list(filter(is_uuid, self.unique("DORA_DATAFLOW")))

    def known_nodes(self, scope: Scope, name: str, wanted: Sequence[str] = ()) -> list[str]:
        """The nodes of the dataflows of `scope` called `name` with a record, sorted.

        wanted: names that are looked for first, because other users can write many names.
        """
        own = scope_matches(scope, name)
        known = set[str]()
        for events in (("node-ready",), NODE_END_EVENTS):
            matches = [*own, *(f"DORA_EVENT={one}" for one in events)]
            records = self.newest(matches, _MOST_NAMES, fields=("DORA_NODE",))
            known |= {node for one in records if is_node_id(node := str(one.get("DORA_NODE", "")))}
        parts = (one.partition("/") for one in self.unique("SYSLOG_IDENTIFIER"))
        others = (node for dataflow, _, node in parts if dataflow == name)
        found = dict.fromkeys(filter(is_node_id, (*wanted, *others)))
        return self._recorded(known, found, lambda node: [*own, f"DORA_NODE={node}"], _MOST_DOUBTED)

    def _recorded(
        self,
        known: set[str],
        found: Iterable[str],
        matches: Callable[[str], list[str]],
        most: int = _MOST_FORGED,
    ) -> list[str]:
        """Return `known`, and those of `found` that really have a record, sorted.

        Any user can write records that look like those of another dataflow. matches: the fields of
        a real record. most: of those that are looked up, one by one.
        """
        doubtful = islice((one for one in found if one not in known), most)
        return sorted(known.union(one for one in doubtful if any(self.newest(matches(one), 1))))

    def count_own(self, since_us: int, until_us: int) -> int:
        """Number of records of this process between two times, inclusive; CLOCK_REALTIME µs."""
        times = (("since", since_us), ("until", until_us))
        options = [f"--{name}={journal_timestamp(us)}" for name, us in times]
        options += ["--quiet", "--boot", "--output=cat", "--output-fields=_PID"]
        output = journal_output([*options, "--", f"_PID={os.getpid()}"])
        return sum(data.count(b"\n") for data in output)

    def name_of(self, scope: Scope, uuid: str) -> str:
        """The name of the dataflow `uuid` of `scope`, "" if it has no record.

        A node can write the UUID of another dataflow, too. Its record has two then: systemd adds
        that of its own dataflow, see LogExtraFields= in systemd.exec(5).
        """
        matches = [*scope_matches(scope), f"DORA_DATAFLOW={uuid}"]
        records = self.newest(matches, None, fields=_NAME_FIELDS)
        own = (one for one in records if one.get("DORA_DATAFLOW") == uuid)
        return next(filter(None, map(_trusted_name, own)), "")

    def newest(
        self,
        matches: Sequence[str],
        limit: int | None,
        until_us: int = 0,
        is_whole: bool = False,
        fields: Sequence[str] = (),
    ) -> Iterator[dict[str, Any]]:
        """The matching records, newest first, as journalctl's JSON has them.

        until_us: CLOCK_REALTIME µs of the newest one, 0 for now. is_whole: include long fields.
        fields: only these, () for all.
        """
        options = [] if limit is None else [f"--lines={limit}"]
        options += [f"--until={journal_timestamp(until_us)}"] if until_us else []
        options += ["--all"] if is_whole else []
        options += [f"--output-fields={','.join(fields)}"] if fields else []
        words = ["--output=json", "--reverse", "--quiet", *options, "--", *matches]
        self.is_cut = False
        for line in _lines(words, self._bounds, self._cut):
            yield json.loads(line)

    def _cut(self) -> None:
        self.is_cut = True

    def last_events(
        self, scope: Scope, limit: int = 100, name: str = "", is_by_name: bool = False
    ) -> list[LastEvent]:
        """The last life event of each of the `limit` newest dataflows, newest first.

        name: only of those with that name. is_by_name: of each name instead of each UUID.
        """
        matches = [f"DORA_EVENT=dataflow-{event}" for event in _LIFE_EVENTS]
        found: dict[tuple[str, str], LastEvent] = {}
        matches = [*scope_matches(scope, name), *matches]
        # Not all fields: a node can write records that fill the bounds of a reading.
        for record in self.newest(matches, None, fields=_EVENT_FIELDS):
            if event := _last_event(record):
                found.setdefault((event.name, "" if is_by_name else event.uuid), event)
            if len(found) >= limit:
                break
        return list(found.values())

    def has_run(self, scope: Scope, name: str, run: str) -> bool:
        """Whether there is a record of the run with that id. name: of its dataflow, "" for any."""
        return any(self.newest([*scope_matches(scope, name), f"DORA_RUN={run}"], 1))

    def starts(self, scope: Scope, name: str, limit: int) -> list[int]:
        """The newest starts of the unit of a dataflow, CLOCK_REALTIME µs, newest first."""
        records = self.newest(start_matches(scope, name), limit)
        return [int(one["__REALTIME_TIMESTAMP"]) for one in records]

    def killed_since(self, scope: Scope, name: str, uuid: str, since_us: int) -> list[str]:
        """The nodes of a dataflow that were killed while it stopped; CLOCK_REALTIME µs."""
        ends = ("DORA_EVENT=node-exited", f"DORA_EXIT={KILLED}", f"DORA_DATAFLOW={uuid}")
        records = self.newest([*scope_matches(scope, name), *ends], _MOST_NAMES)
        new = takewhile(lambda one: int(one["__REALTIME_TIMESTAMP"]) >= since_us, records)
        return list(filter(is_node_id, (str(one.get("DORA_NODE", "")) for one in new)))[::-1]

    def invocations(self, scope: Scope, name: str, uuid: str) -> Iterator[str]:
        """systemd's invocation ids of a dataflow's unit, newest first."""
        matches = [*scope_matches(scope, name), "DORA_EVENT=dataflow-starting"]
        if uuid:
            matches.append(f"DORA_DATAFLOW={uuid}")
        records = self.newest(matches, None)
        ids = (str(record.get("_SYSTEMD_INVOCATION_ID", "")) for record in records)
        yield from (invocation for invocation, _ in groupby(ids) if invocation)


def read_when_written(read: Callable[[], T], is_behind: Callable[[T], bool]) -> T:
    """Call `read`, again for a moment while journald has not yet written what is expected."""
    deadline = time.monotonic() + _MOST_BEHIND
    found = read()
    while time.monotonic() <= deadline and is_behind(found):
        time.sleep(_AGAIN)
        found = read()
    return found


def _lines(
    arguments: Sequence[str], bounds: Bounds, cut: Callable[[], object] = lambda: None
) -> Iterator[bytes]:
    """The lines that journalctl prints, within limits. Raises DoraSystemdError for its error.

    Every node can write to the journal, and fill it with records of 32 MiB each. So this leaves out
    lines that are too long, and ends after so many bytes or the timeout. cut: is called then.
    """
    with open_journalctl(arguments) as child:
        assert child.stdout
        fd, rest, left = child.stdout.fileno(), b"", bounds.size
        deadline = time.monotonic() + bounds.first_seconds
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        while left > 0 and poll.poll(max(deadline - time.monotonic(), 0.0) * 1000):
            if not (data := os.read(fd, CHUNK)):
                if rest and len(rest) <= MAX_LINE:
                    yield rest
                break
            if left == bounds.size:
                deadline = time.monotonic() + bounds.seconds
            left -= len(data)
            *lines, last = data.split(b"\n")
            for line in lines:
                if len(rest) + len(line) <= MAX_LINE:
                    yield rest + line + b"\n"
                rest = b""
            # Keep just enough of a long line to see that it is too long.
            rest = (rest + last)[: MAX_LINE + 1]
        else:
            child.kill()
            cut()
            if left < bounds.size:
                return  # what it has complained of is no reason to show nothing
        end_journalctl(child)


def _trusted_name(record: dict[str, Any]) -> str:
    """The dataflow of a record; "" if the record was forged in the name of another dataflow."""
    name = record.get("DORA_DATAFLOW_NAME")
    if not isinstance(name, str) or not is_name(name):
        return ""
    # journald sets these fields itself; a user's own services have the second one.
    units = (record.get("_SYSTEMD_UNIT"), record.get("_SYSTEMD_USER_UNIT"))
    return name if unit_name(name) in units else ""


def _last_event(record: dict[str, Any]) -> LastEvent | None:
    values = (record.get(field, "") for field in _LIFE_FIELDS)
    uuid, event, ending, reason = (one if isinstance(one, str) else "" for one in values)
    name = _trusted_name(record)
    if not name or not is_uuid(uuid) or event.removeprefix("dataflow-") not in _LIFE_EVENTS:
        return None
    detail = (ending or reason)[:_MOST_DETAIL]
    at_us, cursor = int(record["__REALTIME_TIMESTAMP"]), str(record.get("__CURSOR", ""))
    return LastEvent(name, uuid, event, at_us, detail, cursor)


def _system_files(top: Path) -> list[Path]:
    """The system journal files; if the directory is not readable, assume that they exist."""
    try:
        files = [directory / "system.journal" for directory in top.iterdir()]
    except OSError:
        return []
    return [path for path in files if not os.access(path.parent, os.X_OK) or path.exists()]


def is_volatile(root: Path | None = None) -> bool:
    """Whether the journal is lost at a reboot, see Storage= in journald.conf(5). root: as ROOT."""
    return not _newest(root or ROOT, _PERSISTENT) > _newest(root or ROOT, _VOLATILE)


def place_since(start_us: int, root: Path | None = None) -> Place:
    """Find where journald has written since its start, CLOCK_REALTIME µs. root: as ROOT.

    It writes a record when it starts, and sets the time of a file that it has written to.
    """
    found = {_newest(root or ROOT, one): place for one, place in _PLACES.items()}
    newest = max(found)
    return found[newest] if newest >= start_us else Place.NOWHERE


def _newest(root: Path, top: str) -> float:
    """Return when the newest system journal file was written; without a file, -inf.

    A file that cannot be checked counts as in use.
    """
    return max(map(_written_us, _system_files(root / top)), default=-inf)


def _written_us(path: Path) -> float:
    try:
        return path.stat().st_mtime_ns // 1000
    except OSError:
        return inf


def check_readable(scope: Scope, root: Path | None = None) -> None:
    """Raise DoraSystemdError if this user may not read the records of dataflows of `scope`.

    root: as ROOT.
    """
    root = root or ROOT
    files = [*_system_files(root / _PERSISTENT), *_system_files(root / _VOLATILE)]
    if any(os.access(path, os.R_OK) for path in files):
        return
    if not files:
        hint = without_systemd(root) or "see systemctl status systemd-journald"
        raise DoraSystemdError("cannot find a journal on this machine", hint, ExitCode.NO_SYSTEMD)
    if not scope.is_user:
        raise DoraSystemdError("cannot read the system's journal", JOIN, ExitCode.NO_PERMISSION)
    if is_volatile(root):
        hint = f"it is volatile: {JOIN}, or have Storage=persistent set in journald.conf(5)"
        message = "cannot read the records of user services in this machine's journal"
        raise DoraSystemdError(message, hint, ExitCode.NO_PERMISSION)


def later_failures(events: Sequence[LastEvent]) -> dict[str, int]:
    """Find when units have failed after the last event of their dataflow: µs by UUID.

    Times are CLOCK_REALTIME. The records are systemd's own, because our code may have been killed
    before it could record a failure. Only the system's manager adds the dataflow to such a record,
    see LogExtraFields= in systemd.exec(5). Raises DoraSystemdError.
    """
    known = {event.uuid: event for event in events}
    found: dict[str, int] = {}
    for record in JournalReader().newest(failure_matches(list(known)), _MOST_RECORDS):
        event = known.get(str(record.get("DORA_DATAFLOW", "")))
        if event and record.get("UNIT") == unit_name(event.name) and _is_after(record, event):
            found.setdefault(event.uuid, int(record["__REALTIME_TIMESTAMP"]))
    return found


def _is_after(record: Mapping[str, Any], event: LastEvent) -> bool:
    """Compare by the order in the journal, because the clock may have been set back."""
    source, number = _place(str(record.get("__CURSOR", "")))
    own_source, own_number = _place(event.cursor)
    if source and source == own_source:
        return number > own_number
    return int(record["__REALTIME_TIMESTAMP"]) > event.at_us


def _place(cursor: str) -> tuple[str, int]:
    """Parse the source and the sequence number of a record, see "Cursor" in the Journal Export
    Formats."""
    fields = dict(part.partition("=")[::2] for part in cursor.split(";"))
    return fields.get("s", ""), int(fields.get("i", "0"), 16)

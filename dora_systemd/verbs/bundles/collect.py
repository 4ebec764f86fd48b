"""The sections of a bundle: what each file of it has, by the lists of decisions/bundles/."""

import json
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from dora_systemd.adapters.bundles.store import Section, Sink
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.strain import read_strain
from dora_systemd.adapters.journal.reader import Bounds, JournalReader
from dora_systemd.decisions.bundles.allowlist import (
    OF_SERVICE,
    OF_UNIT,
    VARIABLES,
    export_entry,
    is_kill_of,
    kept_findings,
    kept_properties,
    kept_report,
    kept_row,
    kept_status,
    of_lives,
)
from dora_systemd.decisions.bundles.manifest import WHY, directory_names
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.logs.query import bundle_matches, kernel_matches
from dora_systemd.decisions.views.findings import Finding
from dora_systemd.decisions.views.objects import format_json
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.lives import plain_text
from dora_systemd.decisions.why.report import Report, report_object
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_table
from dora_systemd.trust.rings import RingFile
from dora_systemd.verbs.bundles import recording
from dora_systemd.verbs.facts.cells import Cell

MOST_RECORDS = 30_000
_MOST_BYTES = 24 * 1024 * 1024
_MOST_KERNEL = 2000
_BOUNDS = Bounds(size=96 * 1024 * 1024, first_seconds=5.0, seconds=1.5)
_GZIP = 31
"""wbits of zlib for a file that gunzip(1) reads."""


@dataclass(frozen=True)
class Evidence:
    """What a bundle is made of. cell: None if systemd has unloaded the dataflow."""

    manager: Manager
    scope: Scope
    report: Report
    row: DataflowRow
    cell: Cell | None
    want_journal: bool
    examine: Callable[[], Iterable[Finding]]  # doctor's
    want_pictures: bool = False
    has_lost_power: bool = False  # the life that it is about has ended with the power
    ring: RingFile | None = None  # the ring, if it was opened when the failure was seen
    # what is not in the bundle, and why; a section may add to it while it is written
    left_out: list[str] = field(default_factory=list)

    @property
    def is_up(self) -> bool:
        """Whether the dataflow may have processes."""
        return self.cell is not None and self.cell.has_begun


def sections_of(what: Evidence) -> list[Section]:
    """The sections behind README.txt, in their order."""
    found = [Section(WHY, lambda sink: _put_json(sink, _why(what)))]
    if what.want_journal:
        found.append(Section("journal.export.gz", lambda sink: _put_journal(sink, what)))
    else:
        what.left_out.append("journal.export.gz and lines of nodes: --no-journal")
    if what.cell is not None:
        found.append(Section("unit.txt", lambda sink: _put_lines(sink, _unit(what))))
    else:
        what.left_out.append("unit.txt: systemd has unloaded the dataflow")
    if what.is_up:
        found.append(Section("cgroup.json", lambda sink: _put_json(sink, _groups(what))))
        found.append(Section("nodes.json", lambda sink: _put_json(sink, _nodes(what))))
    else:
        what.left_out.append("cgroup.json and nodes.json: the dataflow does not run")
    found.append(Section("doctor.json", lambda sink: _put_json(sink, _findings(what))))
    if what.report.stack and what.want_journal:
        (name,) = directory_names([what.report.verdict.node or "node"])
        stack = [*map(str, what.report.stack)]
        found.append(Section(f"stacks/{name}.txt", lambda sink: _put_lines(sink, stack)))
    return [*found, *_recording(what)]


def _recording(what: Evidence) -> list[Section]:
    """The sections of the recorder, with the last messages of outputs."""
    if not what.want_journal:
        what.left_out.append(f"{recording.RECORDING}: --no-journal")
        return []
    if what.has_lost_power:
        what.left_out.append(f"{recording.RECORDING}: power was lost")
        return []
    uuid = what.report.subject.uuid
    ring = what.ring or recording.find(what.manager, what.scope, what.cell, uuid)
    if ring is None and what.cell is not None and not what.scope.is_callers:
        return [Section(recording.RECORDING, _refuse)]
    return recording.sections(ring, what.left_out, what.want_pictures)


def _put_json(sink: Sink, value: Any) -> None:
    sink.write(f"{json.dumps(value, indent=2)}\n".encode())


def _put_lines(sink: Sink, lines: Iterable[str]) -> None:
    sink.write("".join(f"{line}\n" for line in lines).encode("utf-8", "replace"))


def _why(what: Evidence) -> dict[str, Any]:
    report = kept_report(what.report, what.want_journal)
    found = report_object(report, kept_row(what.row, what.want_journal))
    return dict(json.loads(format_json(found)))


def _unit(what: Evidence) -> Iterable[str]:
    assert what.cell is not None
    types = what.manager.property_types()
    names = [*OF_UNIT, *(one for one in (*OF_SERVICE, VARIABLES) if one in types)]
    return kept_properties(what.manager.read(what.cell.unit, names))


def _groups(what: Evidence) -> dict[str, Any]:
    assert what.cell is not None
    group = what.manager.read(what.cell.unit, ["ControlGroup"])["ControlGroup"]
    if not group:
        return {}
    path = cgroup.group_path(group)
    return {"dataflow": _numbers(path), "nodes": _node_numbers(path, what)}


def _node_numbers(path: Path, what: Evidence) -> dict[str, Any]:
    groups = cgroup.shown_groups(path, (_status(what) or CellStatus()).nodes)
    return {node: _numbers(one) for node, one in groups.items()}


def _numbers(path: Path) -> dict[str, Any]:
    usage, strain = cgroup.read_usage(path)._asdict(), read_strain(path)._asdict()
    stat = cgroup.read_numbers(path / "memory.stat")
    return {**usage, **strain, "memory_stat": stat, "populated": cgroup.is_populated(path)}


def _status(what: Evidence) -> CellStatus | None:
    assert what.cell is not None
    return read_table(what.scope.cell_directory(what.cell.name))


def _nodes(what: Evidence) -> dict[str, Any]:
    status = _status(what)
    if status is None and not what.scope.is_callers:
        _refuse()
    return kept_status(status or CellStatus())


def _refuse(*_: Sink) -> NoReturn:
    raise DoraSystemdError("only root and the user of the dataflow may read it")


def _findings(what: Evidence) -> Sequence[Mapping[str, Any]]:
    return kept_findings(what.examine())


def _put_journal(sink: Sink, what: Evidence) -> None:
    """Write the newest records of this life and the last one, oldest first."""
    journal, subject = JournalReader(_BOUNDS), what.report.subject
    matches = bundle_matches(what.scope, subject.name, subject.uuid)
    records, size = [], 0
    for record in of_lives(journal.newest(matches, None, is_whole=True), MOST_RECORDS):
        entry = export_entry(record)
        if (size := size + len(entry)) > _MOST_BYTES:
            what.left_out.append("journal.export.gz: older records")
            break
        records.append((_at(record), entry))
    if len(records) == MOST_RECORDS:
        what.left_out.append("journal.export.gz: older records")
    since = min((at for at, _ in records), default=0)
    records += _kernel_records(journal, subject.unit, since)
    records.reverse()  # of the same moment, the order of the journal stays
    pack = zlib.compressobj(wbits=_GZIP)
    for _, entry in sorted(records, key=lambda one: one[0]):
        if data := pack.compress(entry):
            sink.write(data)
    sink.write(pack.flush())


def _kernel_records(journal: JournalReader, unit: str, since: int) -> list[tuple[int, bytes]]:
    """The kernel's records of processes of the unit that it has killed, newest first."""
    pids: set[str] = set()
    newest = [one for one in journal.newest(kernel_matches(), _MOST_KERNEL) if _at(one) >= since]
    found = [one for one in newest[::-1] if is_kill_of(plain_text(one.get("MESSAGE")), unit, pids)]
    return [(_at(one), export_entry(one)) for one in found[::-1]]


def _at(record: Mapping[str, Any]) -> int:
    return int(record.get("__REALTIME_TIMESTAMP", 0))

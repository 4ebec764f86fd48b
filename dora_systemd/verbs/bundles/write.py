"""`doractl bundle`: writes a bundle to a file, or to the store of the dataflow."""

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from dora_systemd import __version__
from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.bundles.store import (
    LEAST,
    REQUESTED,
    STAMP,
    Archive,
    BundleStore,
    Section,
    Sink,
    Stored,
    locked,
    require_replaceable,
    room,
    unwritable,
)
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import note_request, requester
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.bundles.allowlist import kept_report
from dora_systemd.decisions.bundles.manifest import (
    ERRORS,
    MANIFEST,
    README,
    Manifest,
    format_manifest,
)
from dora_systemd.decisions.bundles.readme import format_readme
from dora_systemd.decisions.cell.black_box import BlackBox, Past, is_too_soon, to_remove
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.logs.journal_events import BUNDLE_REFUSED, BUNDLE_WRITTEN
from dora_systemd.decisions.notice.happened import POWER_LOST, Happened
from dora_systemd.decisions.why.report import format_report
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile
from dora_systemd.verbs.bundles.collect import Evidence, sections_of
from dora_systemd.verbs.doctor import examine
from dora_systemd.verbs.facts.cells import Cell, read_cell
from dora_systemd.verbs.why import explain, subject_row

MOST_BYTES = 256 * 1024 * 1024
"""Maximum bytes of a bundle that is requested."""
BY = "doranotice"


def _now_us() -> int:
    return time.time_ns() // 1000


class Written(NamedTuple):
    """A bundle that was written."""

    path: Path
    manifest: Manifest
    errors: tuple[str, ...]  # sections that could not be written

    @property
    def name(self) -> str:
        """The name of the dataflow."""
        return self.manifest.name

    @property
    def uuid(self) -> str:
        """The UUID of the dataflow."""
        return self.manifest.uuid

    @property
    def unit(self) -> str:
        """The unit of the dataflow."""
        return self.manifest.unit


def write_bundle(
    reach: Callable[[Scope], Manager],
    scope: Scope,
    selector: str,
    command: str,
    file: Path | None = None,
    want_journal: bool = True,
    want_pictures: bool = False,
) -> Written:
    """Write a bundle of the dataflow to `file`, by default to its store. Raises DoraSystemdError.

    reach: opens the connection to systemd. command: that requests it, such as "doractl bundle".
    """
    if file is not None:
        require_replaceable(file)
    what = _evidence(reach, scope, selector, want_journal, want_pictures)
    subject = what.report.subject
    manifest = _manifest(what, requester(command))
    if file is not None:
        with _explained(file):
            written = _write(file, min(MOST_BYTES, room(file.parent)), what, manifest)
    else:
        store = BundleStore(scope.state_root, subject.name)
        with locked(store), _explained(store.path):
            store.remove_partial()
            written = _store(store, REQUESTED, MOST_BYTES, what, manifest)
    details = {"scope": scope.word, "file": str(written.path)}
    note_request(BUNDLE_WRITTEN, subject.name, subject.uuid, command, **details)
    return written


def _evidence(
    reach: Callable[[Scope], Manager],
    scope: Scope,
    selector: str,
    want_journal: bool,
    want_pictures: bool = False,
    failure: "Failure | None" = None,
) -> Evidence:
    """Find the dataflow, and what is known of it. Raises DoraSystemdError."""
    manager = reach(scope)
    happened = failure.happened if failure else None
    report = explain(manager, scope, selector, JournalReader(), happened)
    subject = report.subject
    cell = read_cell(manager, subject.unit) if subject.is_loaded else None
    row = subject_row(manager, scope, subject)
    found = partial(examine, reach, scope)
    is_cut = failure is not None and failure.event == POWER_LOST
    more = want_pictures, is_cut, failure.ring if failure else None
    return Evidence(manager, scope, report, row, cell, want_journal, found, *more)


class Failure(NamedTuple):
    """What a bundle is about that nobody has requested."""

    event: str  # one of ORDER of decisions/notice/happened.py, or POWER_LOST
    details: dict[str, str]  # of the event of the bundle
    ring: RingFile | None = None  # of the recorder, opened before the dataflow could be unloaded
    # what the report is about, if the dataflow may have been stopped since
    happened: Happened | None = None


def write_after(
    reach: Callable[[Scope], Manager],
    scope: Scope,
    cell: Cell,
    box: BlackBox,
    failure: Failure,
    now_us: Callable[[], int] = _now_us,
) -> str:
    """Write a bundle after a failure, within the bounds of the setting; return its path, or "".

    Never raises DoraSystemdError: a bundle that is not written is an event.
    """
    try:
        path, problem = _written_after(reach, scope, cell, box, failure, now_us()), ""
    except DoraSystemdError as error:
        path, problem = "", error.message
        store = BundleStore(scope.state_root, cell.name)
        # The event has the reason as well: the disk may be full.
        with suppress(OSError, DoraSystemdError), locked(store):
            store.add_refused(problem, now_us())
    details = {"scope": scope.word, **failure.details}
    details |= {"reason": problem} if problem else {"file": path}
    event = BUNDLE_REFUSED if problem else BUNDLE_WRITTEN
    note_request(event, cell.name, cell.uuid, BY, **details)
    return path


def _written_after(
    reach: Callable[[Scope], Manager],
    scope: Scope,
    cell: Cell,
    box: BlackBox,
    failure: Failure,
    now_us: int,
) -> str:
    """Write the bundle; return its path. Raises DoraSystemdError."""
    happened = failure.happened
    if happened and happened.uuid not in ("", cell.uuid):
        message = "another dataflow with that name has failed, whose black_box is not known"
        raise DoraSystemdError(message, "doractl bundle writes one now")
    what = _evidence(reach, scope, cell.uuid, want_journal=True, failure=failure)
    manifest = replace(_manifest(what, BY), event=failure.event)
    store = BundleStore(scope.state_root, cell.name)
    with locked(store), _explained(store.path):
        store.remove_partial()
        past = [_past(one) for one in store.known() if one.event != REQUESTED]
        if is_too_soon(past, manifest.node, manifest.cause, now_us):
            about = f"node {manifest.node}" if manifest.node else "the same cause"
            message = f"one about {about} was written less than 10 minutes ago"
            raise DoraSystemdError(message, "doractl bundle writes one now")
        store.drop(to_remove(past, box.keep))
        return str(_store(store, failure.event, box.most, what, manifest).path)


def _store(
    store: BundleStore, event: str, most: int, what: Evidence, manifest: Manifest
) -> Written:
    """Write a bundle of at most `most` bytes to the store; call it with the lock."""
    path = store.new_path(time.strftime(STAMP, time.gmtime()), event)
    return _write(path, min(most, room(store.path)), what, manifest)


def _past(one: Stored) -> Past:
    with suppress(DoraSystemdError), opened(one.path) as bundle:
        known = bundle.manifest
        return Past(one.id, one.event, known.at_us, known.node, known.cause)
    return Past(one.id, one.event)


def _manifest(what: Evidence, by: str) -> Manifest:
    subject, verdict = what.report.subject, what.report.verdict
    return Manifest(
        name=subject.name,
        uuid=subject.uuid,
        unit=subject.unit,
        scope=what.scope.word,
        host=os.uname().nodename,
        at_us=time.time_ns() // 1000,
        by=by,
        node=verdict.node,
        cause="" if verdict.cause in (Cause.STOPPED, Cause.FINISHED) else str(verdict.cause),
        summary=verdict.summary,
        state=what.row.status,
        versions={
            "doractl": __version__,
            "python": platform.python_version(),
            "systemd": what.manager.version(),
            "kernel": os.uname().release,
            "machine": os.uname().machine,
        },
    )


def _write(path: Path, most: int, what: Evidence, manifest: Manifest) -> Written:
    """Write all sections, then the errors and the manifest. Raises OSError."""
    sections = sections_of(what)
    with Archive(path, max(most, LEAST), manifest.at_us) as archive:
        archive.add(Section(README, _readme(what, manifest, sections)))
        for one in sections:
            archive.add(one)
        errors = tuple(archive.errors)
        archive.add(Section(ERRORS, _text("".join(f"{one}\n" for one in errors))), reserve=0)
        left_out = (*what.left_out, *(f"{one}: see {ERRORS}" for one in _failed(errors)))
        manifest = replace(manifest, left_out=left_out, parts=tuple(archive.parts))
        archive.add(Section(MANIFEST, _text(format_manifest(manifest))), reserve=0)
    return Written(path, manifest, errors)


def _failed(errors: tuple[str, ...]) -> Iterator[str]:
    yield from (one.partition(":")[0] for one in errors)


def _readme(
    what: Evidence, manifest: Manifest, sections: list[Section]
) -> Callable[[Sink], object]:
    why = format_report(kept_report(what.report, what.want_journal))
    names = [*(one.name for one in sections), ERRORS, MANIFEST]
    return _text(format_readme(manifest, why, names, what.want_journal))


def _text(text: str) -> Callable[[Sink], object]:
    return lambda sink: sink.write(text.encode("utf-8", "replace"))


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn an OSError into a DoraSystemdError that names the file."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error

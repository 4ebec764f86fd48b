"""Sends one notice: writes the report of `doractl why`, and runs the command of the setting.

The unit of a dataflow that is stopped after a failure is gone in a moment, and with it the setting,
the sandbox of the nodes, and the memory of the recorder. `doranotice-hold@.service` keeps the unit
until the service is ready. From then on all of it is in Memory.
"""

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import DOWN, JOB_DONE, Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.files import write_atomic
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.cell.black_box import BlackBox, is_after_boot
from dora_systemd.decisions.logs.journal_events import GIVEN_UP, NOTICE_FAILED, NOTICE_SENT
from dora_systemd.decisions.logs.query import cut_matches
from dora_systemd.decisions.notice.command import is_command, unit_of, words_of
from dora_systemd.decisions.notice.happened import (
    FAILED,
    MOST_ENDS,
    POWER_LOST,
    Happened,
    format_environment,
    has_lost_power,
    main_one,
    summary,
    variables,
)
from dora_systemd.decisions.notice.unit import (
    JSON,
    SECONDS,
    NoticeUnit,
    names_to_copy,
    notice_properties,
)
from dora_systemd.decisions.unit.systemd_versions import transient_commands
from dora_systemd.decisions.why.report import format_report, report_object
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import notice_command_unit, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile
from dora_systemd.verbs.facts.cells import Cell, read_cell
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.start.unit import systemd_number
from dora_systemd.verbs.why import explain, subject_row

BY = "doranotice"
_POLL_SECONDS = 0.2
_MOST_KNOWN = 4
"""Dataflows whose settings are kept: those that were started within a pause."""
_TEXT = "why.txt"
_ENVIRONMENT = "environment"
_RESULTS = {
    "timeout": f"it has not ended within {SECONDS} s",
    "oom-kill": "it has used up its memory",
}


class Noticed(NamedTuple):
    """A dataflow with the setting on_failure or black_box."""

    cell: Cell
    types: Mapping[str, str]  # of properties, by name
    copied: Mapping[str, Any]  # properties that the command has in common with the nodes
    environment: Sequence[str]  # that of the nodes

    @property
    def box(self) -> BlackBox | None:
        """The setting black_box."""
        box: BlackBox | None = self.cell.options.of_dataflow("black_box")
        return box


def read_noticed(manager: Manager, name: str) -> Noticed | None:
    """Read the dataflow `name`; None if systemd does not know it, or it has no such setting.

    Raises DoraSystemdError.
    """
    cell = read_cell(manager, unit_name(name))
    if cell is None or not cell.options.is_noticed:
        return None
    if not is_command(words_of(cell.options)):
        return Noticed(cell, {}, {}, ())
    types = manager.property_types()
    copied = manager.read(cell.unit, names_to_copy(types))
    environment = manager.read(cell.unit, ["Environment"])["Environment"]
    return Noticed(cell, types, copied, environment or ())


class Memory:
    """What was read last of a dataflow, and the ring of its recorder, which is open.

    The next start of the same file is another dataflow with that name, which may have failed when
    the first one is reported.
    """

    def __init__(self, manager: Manager, scope: Scope, name: str) -> None:
        self._manager, self._scope, self._name = manager, scope, name
        self._known: tuple[Noticed, ...] = ()  # the last of each dataflow, newest first
        self._ring: RingFile | None = None

    def learn(self) -> None:
        """Read the dataflow again, if systemd has it still.

        A failure is reported as the dataflow was set then, also if the setting is gone now.
        """
        with suppress(DoraSystemdError):
            if noticed := read_noticed(self._manager, self._name):
                others = (one for one in self._known if one.cell.uuid != noticed.cell.uuid)
                self._known = (noticed, *others)[:_MOST_KNOWN]
                self._open_ring(noticed)

    @property
    def noticed(self) -> Noticed | None:
        """What was read last."""
        return next(iter(self._known), None)

    def of(self, failure: Happened) -> Noticed | None:
        """The dataflow that has failed, if that was read; the last one if it is not recorded."""
        own = (one for one in self._known if failure.uuid in ("", one.cell.uuid))
        return next(own, None)

    def _open_ring(self, noticed: Noticed) -> None:
        if noticed.box is None or not noticed.cell.options.has("record"):
            return
        # Imported late: few dataflows have a recorder.
        from dora_systemd.verbs.bundles.recording import find

        if ring := find(self._manager, self._scope, noticed.cell, noticed.cell.uuid):
            self.close_ring()
            self._ring = ring

    def ring_of(self, uuid: str) -> RingFile | None:
        """The ring of the dataflow with that UUID, if there is one, for one reader."""
        ring = self._ring
        return ring.again() if ring and ring.header.facts.get("uuid") == uuid else None

    def close_ring(self) -> None:
        """Give back the memory of a recorder that systemd has closed meanwhile."""
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    @property
    def is_loaded(self) -> bool:
        """Whether systemd has the dataflow. Raises DoraSystemdError."""
        return read_cell(self._manager, unit_name(self._name)) is not None


class Sender:
    """Sends the notices of one dataflow. place: a directory that only this user can read."""

    def __init__(
        self, manager: Manager, scope: Scope, name: str, journal: JournalReader, place: Path
    ) -> None:
        self._manager, self._scope, self._name = manager, scope, name
        self._journal, self._place = journal, place
        self._memory = Memory(manager, scope, name)

    def learn(self) -> None:
        """Read the setting, and all else of the dataflow that is gone when it is stopped."""
        self._memory.learn()

    def send(self, happened: Sequence[Happened], pause_us: int) -> None:
        """Run the command of the setting, and record the notice, whatever came of it."""
        main = main_one([one for one in happened if self._memory.of(one)] or happened)
        if (noticed := self._memory.of(main) or self._memory.noticed) is None:
            return self._record("", happened, pause_us, self._unnoticed())
        if noticed.box:
            details = {"until": str(happened[0].mono_us), "pause": str(pause_us)}
            self._write_bundle(noticed.cell, noticed.box, main, details)
            if main.what == FAILED:  # this may still follow when a node was given up
                self._memory.close_ring()
        if not noticed.cell.options.has("on_failure"):
            return None
        node = self._write_report(noticed.cell, happened)
        try:
            problem = self._run(noticed, happened, node)
        except DoraSystemdError as error:
            problem = error.message
        return self._record(noticed.cell.uuid, happened, pause_us, problem, node)

    def _unnoticed(self) -> str:
        """Why there is no setting."""
        with suppress(DoraSystemdError):
            if self._memory.is_loaded:
                return "the dataflow has no on_failure any more"
        return f"systemd had unloaded {unit_name(self._name)} before its setting was read"

    def _write_bundle(
        self, cell: Cell, box: BlackBox, main: Happened, details: dict[str, str]
    ) -> None:
        """Write a bundle of a failure, or record why there is none. details: of that record."""
        # Imported late: it has all that doctor checks, and most notices need none.
        from dora_systemd.verbs.bundles.write import Failure, write_after

        about = main if main.what in (FAILED, GIVEN_UP) else None
        ring = self._memory.ring_of(cell.uuid)
        with closing(ring) if ring else nullcontext():
            failure = Failure(main.what, details, ring, about)
            write_after(self._reach, self._scope, cell, box, failure)

    def write_after_boot(self, now_us: int) -> None:
        """Write a bundle of the life that a power cut has ended. now_us: CLOCK_BOOTTIME."""
        noticed = self._memory.noticed
        cell, box = (noticed.cell, noticed.box) if noticed else (None, None)
        if cell is None or box is None or not is_after_boot(box, now_us):
            return
        records = self._journal.newest(cut_matches(self._scope, self._name), MOST_ENDS)
        if has_lost_power(records, now_boot()):
            from dora_systemd.verbs.bundles.write import Failure, write_after

            write_after(self._reach, self._scope, cell, box, Failure(POWER_LOST, {}))
        elif self._journal.is_cut:
            text = "<4>cannot find out whether power was lost: the journal was read only in part"
            print(text, file=sys.stderr)

    def _reach(self, scope: Scope) -> Manager:
        return self._manager if scope == self._scope else Bus(scope, for_reading=True)

    def _write_report(self, cell: Cell, happened: Sequence[Happened]) -> str:
        """Write the report of `doractl why`, as text and JSON; return the node that it names."""
        head = summary(self._name, os.uname().nodename, happened)
        try:
            report = explain(self._manager, self._scope, cell.uuid, self._journal)
            row = subject_row(self._manager, self._scope, report.subject)
            text, found = format_report(report), report_object(report, row)
            node = report.verdict.node
        except DoraSystemdError as error:
            text, found, node = f"{error.message}; {error.hint}", {}, ""
        write_atomic(self._place / _TEXT, f"{head}\n\n{text}\n", 0o600)
        write_atomic(self._place / JSON, json.dumps(found), 0o600)
        return node

    def _run(self, noticed: Noticed, happened: Sequence[Happened], node: str) -> str:
        """Run the command, or start the unit; return what went wrong, or ""."""
        cell, copied = noticed.cell, noticed.copied
        own, host = notice_command_unit(self._name), os.uname().nodename
        unit = unit_of(words_of(cell.options), self._name)
        is_here = self._scope.is_user or unit
        evidence = self._place / JSON if is_here else Path("/run/credentials") / own / JSON
        values = variables(self._name, host, cell.unit, happened, node, str(evidence))
        if unit:
            write_atomic(self._place / _ENVIRONMENT, format_environment(values), 0o600)
            return self._start(unit)
        if not self._scope.is_user and not copied.get("User"):
            return f"{cell.unit} has no User="
        wanted = NoticeUnit(
            name=self._name,
            uuid=cell.uuid,
            words=words_of(cell.options),
            directory=cell.options.working_directory,
            environment=(*noticed.environment, *(f"{key}={text}" for key, text in values.items())),
            stdin=str(self._place / _TEXT),
            evidence=str(self._place / JSON),
            cell_directory=str(self._scope.cell_directory(self._name)),
            is_user=self._scope.is_user,
        )
        self._forget(own)
        number = systemd_number(self._manager)
        properties = transient_commands(notice_properties(wanted, copied, noticed.types), number)
        result = self._manager.start_transient(own, properties, None, wait=True)
        return "" if result == JOB_DONE else self._problem(own)

    def _start(self, unit: str) -> str:
        """Start the unit of the setting, and wait a moment for its end, because it reads files."""
        self._manager.queue_job("StartUnit", unit)
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            state = self._manager.read(unit, ["ActiveState", "Job"])
            if not (state["Job"] or (0,))[0] and state["ActiveState"] != "activating":
                return f"{unit} failed" if state["ActiveState"] == "failed" else ""
            time.sleep(_POLL_SECONDS)
        return f"{unit} has not started within {SECONDS} s"

    def _problem(self, unit: str) -> str:
        facts = self._manager.read(unit, ["Result", "ExecMainStatus", "ActiveState"])
        if facts["ActiveState"] in DOWN:
            self._forget(unit)
        plain = f"{facts['Result']}, exit status {facts['ExecMainStatus']}"
        return _RESULTS.get(str(facts["Result"]), plain)

    def _forget(self, unit: str) -> None:
        if self._manager.read(unit, ["ActiveState"])["ActiveState"] == "failed":
            self._manager.reset_failed(unit)

    def _record(
        self, uuid: str, happened: Sequence[Happened], pause_us: int, problem: str, node: str = ""
    ) -> None:
        """Write the record that the next notice begins after."""
        text = summary(self._name, os.uname().nodename, happened, node)
        note_request(
            NOTICE_FAILED if problem else NOTICE_SENT,
            self._name,
            uuid,
            BY,
            reason=problem or text,
            count=str(len(happened)),
            until=str(happened[0].mono_us),
            pause=str(pause_us),
        )

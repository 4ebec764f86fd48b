"""`doractl why`: collects what systemd, the journal and the runner know about a dataflow."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import takewhile

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.journal.reader import JournalReader, read_when_written
from dora_systemd.decisions.cell.core_dumps import keeps_core_dumps
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.cell.status import GATHERING, HELD, CellStatus, is_stopped
from dora_systemd.decisions.life import node_table
from dora_systemd.decisions.life.causes import NO_END
from dora_systemd.decisions.logs.journal_events import GIVEN_UP
from dora_systemd.decisions.logs.query import scope_matches
from dora_systemd.decisions.notice.happened import Happened
from dora_systemd.decisions.releases.past import FAILED as TRIAL_FAILED
from dora_systemd.decisions.releases.past import Switch, completed, undone
from dora_systemd.decisions.resources.containers import format_outside
from dora_systemd.decisions.views.dataflows import DEGRADED, FAILED, FROZEN
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.last_lines import Word, choose_last, shown_last
from dora_systemd.decisions.why.lives import SHUTDOWN_MESSAGE, lives_until, plain_text
from dora_systemd.decisions.why.postmortem import examine
from dora_systemd.decisions.why.report import LINES, Report, Subject
from dora_systemd.decisions.why.stack import Frame, is_of_stack
from dora_systemd.decisions.why.verdict import Facts, Verdict
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import release_of, unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.budget import read_restarts, restart_budget, without_refused
from dora_systemd.verbs.facts.cells import Cell, read_cell, read_cells
from dora_systemd.verbs.facts.containers import read_containers
from dora_systemd.verbs.facts.ended import newest_ended, not_recorded, with_cause
from dora_systemd.verbs.facts.held import read_held
from dora_systemd.verbs.facts.list import current_text, mark_enabled, read_rows
from dora_systemd.verbs.facts.lives import now_boot, read_lives
from dora_systemd.verbs.facts.locks import read_holders
from dora_systemd.verbs.facts.reading import look_at_table, read_dataflow, read_status
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.facts.stack import read_pattern, read_stack
from dora_systemd.verbs.facts.waits import read_cpu_waits
from dora_systemd.verbs.list import mark_bundles, read_of_failures, read_whole_rows

_MOST_SHUTDOWNS = 20
_FEWEST_LINES = 5
"""Number of last lines with a long stack."""
WORDS_OF_START = 10
"""Maximum number of lines that a failed start prints."""


def explain(
    manager: Manager,
    scope: Scope,
    selector: str,
    journal: JournalReader,
    failure: Happened | None = None,
) -> Report:
    """Explain what happened to the dataflow of `selector`, and why.

    failure: then the report is about the dataflow as it was at that failure.
    Raises DoraSystemdError: NOT_FOUND, USAGE if several match.
    """
    cell, subject = _select(manager, scope, selector)
    if failure is not None:
        facts = _facts_then(failure)
    else:
        facts = _facts(manager, scope, cell) if cell else Facts(now_boot=now_boot())
    verdict = _verdict(journal, scope, subject, facts, failure.at_us if failure else 0)
    budget = None
    if cell and not verdict.is_given_up:
        budget = restart_budget(manager, scope, cell, read_status(scope, cell))
    last = _undone(scope, subject)
    stack = read_stack(journal, scope, subject.name, verdict)
    words = _last_words(journal, scope, subject, verdict, stack)
    is_of_trial = not words and last is not None and last.how == TRIAL_FAILED
    if last and is_of_trial:
        words = _trial_words(journal, scope, subject, last)
    inhibitors = read_holders(scope, [cell.name]).get(cell.name, ()) if cell else ()
    is_held = cell is not None and _is_held(scope, cell, verdict.node)
    machines = _machines(manager, cell) if cell and cell.options.placed else {}
    more = (last, is_of_trial, stack, keeps_core_dumps(read_pattern()))
    report = Report(subject, verdict, words, budget, inhibitors, is_held, machines, *more)
    return replace(report, bundles=read_of_failures(scope, subject.name))


def explain_now(manager: Manager, scope: Scope, selector: str, journal: JournalReader) -> Report:
    """Explain as explain(), and what the nodes do now, which may take a moment.

    That is what they wait for, and the containers that they have started.
    """
    report = explain(manager, scope, selector, journal)
    is_there = report.verdict.is_up and report.subject.is_loaded
    if not is_there or (cell := read_cell(manager, report.subject.unit)) is None:
        return report
    reading = read_dataflow(manager, scope, cell)
    outside = format_outside(read_containers(reading.groups))
    return replace(report, waits=read_cpu_waits(reading), outside=outside)


def _facts_then(failure: Happened) -> Facts:
    if failure.what != GIVEN_UP:
        return Facts(now_boot=now_boot())
    return Facts(DEGRADED, failed={failure.node: failure.cause}, now_boot=now_boot())


def _verdict(
    journal: JournalReader, scope: Scope, subject: Subject, facts: Facts, until_us: int
) -> Verdict:
    """The verdict of the journal. until_us: of the last record that counts, or 0.

    systemd knows that a unit has ended before journald has written what systemd and the runner
    report of that end, so an end without any record is read again.
    """
    shutdowns = _shutdowns(journal)

    def read() -> Verdict:
        lives = read_lives(journal, scope, subject.name, subject.uuid, subject.is_loaded)
        return examine(lives_until(lives, until_us), facts, shutdowns)

    return read_when_written(read, lambda one: subject.is_loaded and one.summary == NO_END)


def _trial_words(
    journal: JournalReader, scope: Scope, subject: Subject, end: Switch
) -> tuple[Word, ...]:
    """The last lines of the node that failed in the trial of a release, or of all nodes."""
    matches = scope_matches(scope, subject.name)
    matches += [f"DORA_NODE={end.node}"] if end.node else []
    matches += [f"_SYSTEMD_INVOCATION_ID={end.invocation}"] if end.invocation else []
    records = journal.newest(matches, None, until_us=end.at_us, is_whole=True)
    return choose_last(records, LINES)


def _undone(scope: Scope, subject: Subject) -> Switch | None:
    """Read how the last release ended, if no newer one runs instead; None if that is not known."""
    # Imported late: few dataflows have releases.
    from dora_systemd.verbs.releases.listing import store_of

    with suppress(DoraSystemdError):  # only its owner may read it
        store = store_of(scope, subject.name)
        return undone(completed(store.history(), release_of(subject.file)))
    return None


def newest_failure(manager: Manager, scope: Scope) -> str:
    """The UUID of the dataflow that failed last: a degraded one that runs, or one that has ended.

    Raises DoraSystemdError: NOT_FOUND if none has failed.
    """
    rows = read_rows(manager, scope)
    ended = newest_ended(manager, scope, rows, None)
    degraded = sorted((row for row in rows if row.status == DEGRADED), key=lambda row: -row.ready)
    failed = [*degraded, *(row for row in ended if row.status == FAILED)]
    if not failed:
        names = ", ".join(row.name for row in rows)
        hint = f"known dataflows: {names}" if names else "doractl list --all"
        raise DoraSystemdError("no dataflow has failed", hint, ExitCode.NOT_FOUND)
    return failed[0].uuid


def _machines(manager: Manager, cell: Cell) -> dict[str, str]:
    """The other machines of a dataflow, each with its host."""
    # Imported late: most dataflows run on one machine.
    from dora_systemd.verbs.facts.machines import member_hosts

    found = member_hosts(manager, cell.options)
    return {machine: host.text if host else "" for machine, host in found.items()}


def _is_held(scope: Scope, cell: Cell, node: str) -> bool:
    """Whether hot reload starts this node again when its files change."""
    status = read_status(scope, cell).nodes.get(node) if node and cell.is_up else None
    return status is not None and status.policy == HELD


def _select(manager: Manager, scope: Scope, selector: str) -> tuple[Cell | None, Subject]:
    wanted = Selector(selector)
    if not wanted.meant(read_cells(manager)) and (ended := wanted.ended(scope)):
        return _with_file(manager, scope, ended.uuid, ended.name)
    try:
        cell = wanted.find(manager)
    except DoraSystemdError as error:
        raise not_recorded(error) from error
    return cell, _subject(scope, cell)


def _with_file(manager: Manager, scope: Scope, uuid: str, name: str) -> tuple[Cell | None, Subject]:
    """An ended dataflow; an enabled one has a unit file even if systemd has not loaded it."""
    cell = read_cell(manager, unit_name(name))
    if cell is not None and cell.uuid == uuid:
        return cell, _subject(scope, cell)
    # Imported late: most dataflows run.
    from dora_systemd.verbs.start.restart_ended import recorded_file

    file = recorded_file(scope, name, uuid)
    return None, Subject(uuid, name, unit_name(name), scope.flag, file)


def _subject(scope: Scope, cell: Cell) -> Subject:
    return Subject(cell.uuid, cell.name, cell.unit, scope.flag, cell.options.dataflow, True)


def _facts(manager: Manager, scope: Scope, cell: Cell) -> Facts:
    if cell.state.is_held:
        return _held_facts(manager, cell)
    status, problem = look_at_table(scope, cell) if cell.is_up else (CellStatus(), "")
    nodes, spent = status.nodes.items(), node_table.spent(status.nodes)
    unit = manager.read(cell.unit, ["StatusText", "NRestarts", "ControlGroup"])
    group = unit["ControlGroup"]
    is_frozen = bool(group) and cgroup.is_frozen(cgroup.group_path(group))
    return Facts(
        FROZEN if is_frozen else cell.word(status.stage),
        problem or current_text(cell, str(unit["StatusText"])),
        {key: spent.get(key, str(node.exit)) for key, node in nodes if node.state == "failed"},
        tuple(key for key, node in nodes if node.state == "restarting"),
        now_boot(),
        without_refused(manager, cell, unit["NRestarts"]),
        {key: node.silent for key, node in nodes if node.silent},
        is_gathering=status.stage == GATHERING,
        stopped={key: node.asked_by for key, node in nodes if is_stopped(node)},
        policy=restart_of(cell.options).policy,
    )


def _held_facts(manager: Manager, cell: Cell) -> Facts:
    held = read_held(manager, cell)
    restarts = read_restarts(manager, cell)
    return Facts(held.word, held.text, {}, (), now_boot(), restarts, is_held=True)


def _shutdowns(journal: JournalReader) -> list[int]:
    records = journal.newest([f"MESSAGE_ID={SHUTDOWN_MESSAGE}", "_UID=0"], _MOST_SHUTDOWNS)
    return [int(one["__REALTIME_TIMESTAMP"]) for one in records]


def _last_words(
    journal: JournalReader, scope: Scope, subject: Subject, verdict: Verdict, stack: Sequence[Frame]
) -> tuple[Word, ...]:
    """The last lines of the node that failed first, up to its end; else those of all nodes.

    stack: of that node. If Python has written it, it is not repeated.
    """
    if not (verdict.is_failure or verdict.node) or not verdict.invocation:
        return ()
    invocation = f"_SYSTEMD_INVOCATION_ID={verdict.invocation}"
    matches = [*_own_matches(scope, subject), invocation]
    if verdict.node:
        matches.append(f"DORA_NODE={verdict.node}")
    records = journal.newest(matches, None, until_us=verdict.at_us, is_whole=True)
    if stack:
        own = (one for one in records if not is_of_stack(plain_text(one.get("MESSAGE"))))
        return choose_last(own, max(LINES - len(stack), _FEWEST_LINES))
    return choose_last(records, LINES)


def subject_row(manager: Manager, scope: Scope, subject: Subject) -> DataflowRow:
    """The dataflow of a report, as `list` knows it."""
    cell = read_cell(manager, subject.unit) if subject.is_loaded else None
    if cell is not None:
        return read_whole_rows(manager, scope, [cell])[0]
    known = DataflowRow(subject.uuid, subject.name, subject.unit, "", subject.file)
    ended = with_cause(scope, Selector(subject.uuid).ended(scope) or known)
    row = ended._replace(dataflow=subject.file)
    return mark_bundles(scope, mark_enabled(manager, scope, [row]))[0]


def _own_matches(scope: Scope, subject: Subject) -> list[str]:
    return [*scope_matches(scope, subject.name), f"DORA_DATAFLOW={subject.uuid}"]


def words_of_start(manager: Manager, scope: Scope, uuid: str) -> list[str]:
    """The last lines of a dataflow whose start failed, with their node, oldest first.

    The lines are those of the node that failed first; of all nodes, if that node has written
    nothing or is not known. [] if the journal cannot be read.
    """
    journal = JournalReader()
    with suppress(DoraSystemdError):
        report = explain(manager, scope, uuid, journal)
        words = report.words
        if not words:
            began = report.verdict.began_us  # what was written before is of another start
            records = journal.newest(_own_matches(scope, report.subject), None)
            own = takewhile(lambda one: int(one["__REALTIME_TIMESTAMP"]) >= began, records)
            words = choose_last(own, WORDS_OF_START)
        return [f"{one.node}: {one.text}" for one in shown_last(words, WORDS_OF_START)]
    return []

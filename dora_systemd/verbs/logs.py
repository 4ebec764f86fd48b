"""`doractl logs` and `doractl run`: read the records of a dataflow from the journal."""

import os
import re
import select
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import islice
from typing import NamedTuple

from dora_systemd.adapters.journal.reader import (
    JournalReader,
    end_journalctl,
    journal_output,
    open_journalctl,
)
from dora_systemd.decisions.logs.fields import ExportReader
from dora_systemd.decisions.logs.query import (
    UNIT_ENDS,
    LogQuery,
    end_matches,
    journal_timestamp,
    query_arguments,
    query_matches,
)
from dora_systemd.decisions.logs.records import LOG_FIELDS, Record
from dora_systemd.decisions.logs.terminal import ShownLines, TerminalLines
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.ended import volatile_note
from dora_systemd.verbs.facts.selector import Selector

_TURN = 1 << 14
"""Bytes of records between two looks at what else has happened: a terminal may be slow."""
_GLOB = re.compile(r"[*?\[]")
_FIELDS = ",".join((*LOG_FIELDS, "SYSLOG_IDENTIFIER"))

Write = Callable[[bytes], object]


class _Recorded(NamedTuple):
    """A dataflow in the journal."""

    name: str
    uuid: str


def find_query(
    journal: JournalReader,
    query: LogQuery,
    selector: str,
    nodes: tuple[str, ...] = (),
    run: str = "ALL",
) -> LogQuery:
    """The query, with the name, nodes and run that the journal has for it.

    selector: "" for all dataflows of the scope. nodes: names or patterns as in glob(7). run:
    CURRENT, PREVIOUS, ALL, or dora's id of a run. Raises DoraSystemdError: NOT_FOUND for a
    dataflow, node or run without any record.
    """
    if selector:
        query = _select_dataflow(journal, query, selector)
    if nodes:
        query = replace(query, nodes=_select_nodes(journal, query, nodes))
    return _select_run(journal, query, run)


def _select_dataflow(journal: JournalReader, query: LogQuery, selector: str) -> LogQuery:
    names = journal.known_names()
    wanted = Selector(selector)
    if wanted.name in names:
        return replace(query, name=wanted.name)
    fitting = wanted.meant(_Recorded("", uuid) for uuid in journal.known_uuids())
    found = wanted.only(_Recorded(journal.name_of(one.uuid), one.uuid) for one in fitting)
    if found is None:
        error = wanted.missing(names)
        error.hint += volatile_note()
        raise error
    return replace(query, uuid=found.uuid, name=found.name)


def _select_nodes(
    journal: JournalReader, query: LogQuery, patterns: tuple[str, ...]
) -> tuple[str, ...]:
    if not query.name:
        hint = "say which dataflow: doractl logs NAME --node NODE"
        raise DoraSystemdError("cannot select nodes of all dataflows", hint, ExitCode.USAGE)
    known = journal.known_nodes(query.name)
    found: dict[str, None] = {}
    for pattern in patterns:
        fitting = [node for node in known if _fits(node, pattern)]
        if not fitting:
            there = f"nodes: {', '.join(known)}" if known else "no node has written anything yet"
            message = f"cannot find a node {quoted(pattern)} of dataflow {query.name}"
            raise DoraSystemdError(message, there, ExitCode.NOT_FOUND)
        found.update(dict.fromkeys(fitting))
    return tuple(found)


def _fits(node: str, pattern: str) -> bool:
    return node == pattern or (bool(_GLOB.search(pattern)) and fnmatchcase(node, pattern))


def _select_run(journal: JournalReader, query: LogQuery, run: str) -> LogQuery:
    if run == "ALL":
        return query
    if run not in ("CURRENT", "PREVIOUS"):
        if run and not journal.has_run(query.name, run):
            message = f"cannot find the run {quoted(run)}"
            hint = "doractl list --all, or journalctl --field=DORA_RUN"
            raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND)
        return replace(query, run=run)
    if not query.name:
        hint = "say which dataflow: doractl logs NAME --run CURRENT"
        raise DoraSystemdError("cannot select a run of all dataflows", hint, ExitCode.USAGE)
    index = 0 if run == "CURRENT" else 1
    lives = journal.invocations(query.scope, query.name, query.uuid)
    invocation = next(islice(lives, index, None), None)
    if invocation is None:
        message = f"cannot find the {run.lower()} run of dataflow {query.name}"
        raise DoraSystemdError(message, "--run ALL shows all there is", ExitCode.NOT_FOUND)
    return replace(query, invocation=invocation)


def read_logs(
    query: LogQuery, terminal: TerminalLines | ShownLines | None = None, want_colors: bool = False
) -> Iterator[bytes]:
    """The output of journalctl for a query, in chunks; formatted by `terminal` if given.

    Raises DoraSystemdError: USAGE for a time or pattern that journalctl does not accept.
    """
    for data in journal_output(query_arguments(query), want_colors=want_colors):
        yield terminal.feed(data) if terminal else data


def pass_logs(query: LogQuery, fd: int) -> int:
    """Let journalctl write the records of a query directly to `fd`; its exit status.

    Raises DoraSystemdError as read_logs does.
    """
    with open_journalctl(query_arguments(query), stdout=fd) as child:
        return end_journalctl(child)


class Follower:
    """A `journalctl --follow`, for poll(2). Use it with contextlib.closing().

    since_us: CLOCK_REALTIME µs of the first records. outlives_interrupt: see open_journalctl().
    """

    def __init__(
        self, since_us: int, fields: str, matches: Sequence[str], outlives_interrupt: bool = False
    ) -> None:
        options = ["--follow", "--quiet", "--output=export", f"--output-fields={fields}"]
        arguments = [*options, f"--since={journal_timestamp(since_us)}", "--", *matches]
        self._stack = ExitStack()
        journalctl = open_journalctl(arguments, outlives_interrupt=outlives_interrupt)
        child = self._stack.enter_context(journalctl)
        assert child.stdout
        self._fd = child.stdout.fileno()
        os.set_blocking(self._fd, False)
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def fileno(self) -> int:
        """For poll(2): readable when there may be records."""
        return self._fd

    def is_readable(self, seconds: float) -> bool:
        """Wait at most `seconds`; whether there may be records."""
        return bool(self._poll.poll(seconds * 1000))

    def read(self, size: int) -> bytes | None:
        """At most `size` bytes, b"" at the end, None if there is nothing to read now."""
        try:
            return os.read(self._fd, size)
        except BlockingIOError:
            return None

    def close(self) -> None:
        """Terminate the journalctl process."""
        self._stack.close()


class FollowedLog(Follower):
    """The records of a dataflow's unit, while it runs and up to its end.

    since_us: CLOCK_REALTIME µs of the start of the unit. write: called with the lines. form: the
    lines of a record, b"" to leave it out.
    """

    def __init__(
        self,
        scope: Scope,
        name: str,
        uuid: str,
        since_us: int,
        write: Write,
        form: Callable[[Record], bytes],
    ) -> None:
        matches = [*query_matches(LogQuery(scope, name=name, uuid=uuid)), "+"]
        matches += end_matches(scope, name)
        # After the first Ctrl+C the nodes still have to say something.
        super().__init__(since_us, _FIELDS, matches, outlives_interrupt=True)
        self.has_ended = False
        self._write = write
        self._form = form
        self._records = ExportReader()
        self._is_closed = False

    def print_new(self) -> None:
        """Write some of the lines that have come: a flood of them must not keep the caller here."""
        data = None if self._is_closed else self.read(_TURN)
        if data is not None:
            self.has_ended = self._is_closed = not data
            self._print(data)

    def _print(self, data: bytes) -> None:
        lines: list[bytes] = []
        for record in self._records.feed(data):
            # After an automatic restart more records follow.
            self.has_ended = record.get("MESSAGE_ID", b"").decode() in UNIT_ENDS
            if not self.has_ended:
                lines.append(self._form(record))
        if text := b"".join(lines):
            self._write(text)

    def finish(self, seconds: float = 3.0) -> None:
        """Write the remaining lines of a unit that has ended; wait at most `seconds`."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0 and not self._is_closed:
            if not self.is_readable(0 if self.has_ended else left):
                return
            self.print_new()

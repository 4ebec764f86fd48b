"""`doractl logs` and `doractl run`: read the records of a dataflow from the journal."""

import os
import re
import select
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import islice
from typing import Protocol

from dora_systemd.adapters.journal.reader import (
    end_journalctl,
    is_volatile,
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
from dora_systemd.decisions.logs.terminal import ShownLines, TerminalLines
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_uuid_prefix, name_from_unit
from dora_systemd.scope import Scope
from dora_systemd.suggestions import did_you_mean
from dora_systemd.values import quoted

_TURN = 1 << 14
"""Bytes of records between two looks at what else has happened: a terminal may be slow."""
_GLOB = re.compile(r"[*?\[]")
_FIELDS = "MESSAGE,PRIORITY,SYSLOG_IDENTIFIER,MESSAGE_ID,UNIT,USER_UNIT"

Write = Callable[[bytes], object]


class Journal(Protocol):
    """The part of dora_systemd.adapters.journal.reader.JournalReader that this module uses."""

    def known_names(self) -> list[str]:
        """Names of dataflows."""

    def known_uuids(self) -> list[str]:
        """UUIDs of dataflows."""

    def known_nodes(self, name: str) -> list[str]:
        """Nodes of a dataflow."""

    def name_of(self, uuid: str) -> str:
        """The name of a dataflow."""

    def invocations(self, scope: Scope, name: str, uuid: str) -> Iterator[str]:
        """Invocations of its unit, newest first."""


@dataclass(frozen=True)
class LogRequest:
    """A request for logs: a query whose names and patterns are not resolved yet.

    selector: "" for all dataflows of the scope. nodes: names or patterns as in glob(7). run:
    CURRENT, PREVIOUS, ALL, or dora's id of a run.
    """

    selector: str
    nodes: tuple[str, ...]
    run: str
    query: LogQuery


def find_query(journal: Journal, request: LogRequest) -> LogQuery:
    """The query, with name, nodes and run resolved by the journal.

    Raises DoraSystemdError: NOT_FOUND for a dataflow, node or run without any record.
    """
    query = request.query
    if request.selector:
        query = _select_dataflow(journal, query, request.selector)
    if request.nodes:
        query = replace(query, nodes=_select_nodes(journal, query, request.nodes))
    return _select_run(journal, query, request.run)


def _select_dataflow(journal: Journal, query: LogQuery, selector: str) -> LogQuery:
    names = journal.known_names()
    name = name_from_unit(selector) or selector
    if name in names:
        return replace(query, name=name)
    uuids = journal.known_uuids() if is_uuid_prefix(selector) else []
    found = [uuid for uuid in uuids if uuid.startswith(selector.lower())]
    if len(found) > 1:
        message = f"cannot tell which dataflow {quoted(selector)} is"
        raise DoraSystemdError(message, f"one of {', '.join(found[:10])}", ExitCode.USAGE)
    if not found:
        raise _unknown_dataflow(selector, names)
    return replace(query, uuid=found[0], name=journal.name_of(found[0]))


def _unknown_dataflow(selector: str, names: list[str]) -> DoraSystemdError:
    hint = did_you_mean(selector, names)
    if not hint and names:
        hint = f"in the journal: {', '.join(names[:10])}"
    if is_volatile():
        hint = f"{hint + '; ' if hint else ''}the journal is volatile: a reboot empties it"
    message = f"no dataflow named {quoted(selector)} in the journal"
    return DoraSystemdError(message, hint, ExitCode.NOT_FOUND)


def _select_nodes(journal: Journal, query: LogQuery, patterns: tuple[str, ...]) -> tuple[str, ...]:
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


def _select_run(journal: Journal, query: LogQuery, run: str) -> LogQuery:
    if run == "ALL":
        return query
    if run not in ("CURRENT", "PREVIOUS"):
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
    query: LogQuery, terminal: TerminalLines | ShownLines | None = None
) -> Iterator[bytes]:
    """The output of journalctl for a query, in chunks; formatted by `terminal` if given.

    Raises DoraSystemdError: USAGE for a time or pattern that journalctl does not accept.
    """
    for data in journal_output(query_arguments(query), want_colors=terminal is not None):
        yield terminal.feed(data) if terminal else data


def pass_logs(query: LogQuery, fd: int) -> int:
    """Let journalctl write the records of a query directly to `fd`; its exit status.

    Raises DoraSystemdError as read_logs does.
    """
    with open_journalctl(query_arguments(query), stdout=fd) as child:
        return end_journalctl(child)


class FollowedLog:
    """The records of one invocation of a dataflow's unit, while it runs and up to its end.

    since_us: CLOCK_REALTIME µs of the start of the unit. write: called with the lines.
    """

    def __init__(
        self,
        scope: Scope,
        name: str,
        uuid: str,
        since_us: int,
        write: Write,
        terminal: TerminalLines,
    ) -> None:
        query = LogQuery(scope, name=name, uuid=uuid)
        since = f"--since={journal_timestamp(since_us)}"
        options = ["--follow", "--quiet", "--output=export", f"--output-fields={_FIELDS}", since]
        matches = [*query_matches(query), "+", *end_matches(scope, name)]
        self.has_ended = False
        self._write = write
        self._terminal = terminal
        self._records = ExportReader()
        self._stack = ExitStack()
        # After the first Ctrl+C the nodes still have to say something.
        journalctl = open_journalctl([*options, "--", *matches], outlives_interrupt=True)
        child = self._stack.enter_context(journalctl)
        assert child.stdout
        self._fd = child.stdout.fileno()
        os.set_blocking(self._fd, False)

    def fileno(self) -> int:
        """For poll(2): readable when there may be lines."""
        return self._fd

    def print_new(self) -> None:
        """Write some of the lines that have come: a flood of them must not keep the caller here."""
        if self.has_ended:
            return
        try:
            data = os.read(self._fd, _TURN)
        except BlockingIOError:
            return
        if not data:
            self.has_ended = True
        self._print(data)

    def _print(self, data: bytes) -> None:
        lines: list[bytes] = []
        for record in self._records.feed(data):
            if record.get("MESSAGE_ID", b"").decode() in UNIT_ENDS:
                self.has_ended = True
                break
            lines.append(self._terminal.record(record))
        if lines:
            self._write(b"".join(lines))

    def finish(self, seconds: float = 3.0) -> None:
        """Write the remaining lines of a unit that has ended; wait at most `seconds`."""
        deadline = time.monotonic() + seconds
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        while not self.has_ended and (left := deadline - time.monotonic()) > 0:
            poll.poll(left * 1000)
            self.print_new()

    def close(self) -> None:
        """Terminate the journalctl process."""
        self._stack.close()

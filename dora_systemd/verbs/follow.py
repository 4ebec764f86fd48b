"""`doractl logs --until-end`: print the records of a dataflow until it has ended.

journalctl(1) selects and formats the records, but `journalctl --follow` never ends. So follow_steps
calls journalctl once for each step: first for the existing records, then for those after the
cursor, and once more after the end. A cursor file connects the steps, --cursor-file= in
journalctl(1).

UnitWatch, a `journalctl --follow` that prints only message IDs, triggers the next step. UnitWatch
starts before the first step, so no record is missed between the two. systemd logs the end of a unit
on restarts too; so the ActiveState and the job of the unit decide whether more will come. The order
matters: is_up() comes before the last step, or records written in between would be missing.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from dora_systemd.adapters.bus.manager import Manager, is_at_rest
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.logs.query import (
    UNIT_ENDS,
    LogQuery,
    end_matches,
    journal_timestamp,
    scope_matches,
)
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.logs import Follower, find_span

STEP_SECONDS = 0.2
"""At least this long between two steps: journalctl needs tens of ms to open all journal files."""
POLL_SECONDS = 2.0
"""Interval of the checks of the unit without new records: that of its end can be missing."""
END_SECONDS = 3.0
FIRST_LINES = 10
"""The default of journalctl --follow."""

_CHUNK = 1 << 18


class Watch(Protocol):
    """The part of UnitWatch that follow_steps() needs."""

    def wait(self, seconds: float) -> bool:
        """Wait for a new record, at most `seconds`; whether there is one."""

    def take_end(self) -> bool:
        """Whether systemd has logged an end of the unit since the last call."""


class UnitWatch(Follower):
    """Watches the journal for new records of a unit and of its end.

    since_us: CLOCK_REALTIME in µs; earlier records do not count.
    """

    def __init__(self, scope: Scope, name: str, since_us: int) -> None:
        matches = [*scope_matches(scope, name), "+", *end_matches(scope, name)]
        super().__init__(since_us, "MESSAGE_ID", matches)
        self._rest = b""
        self._has_ended = False

    def wait(self, seconds: float) -> bool:
        if not self.is_readable(seconds):
            return False
        while data := self.read(_CHUNK):
            seen = self._rest + data
            self._has_ended |= any(one.encode() in seen for one in UNIT_ENDS)
            self._rest = seen[-len(UNIT_ENDS[0]) :]
        return True

    def take_end(self) -> bool:
        ended, self._has_ended = self._has_ended, False
        if ended:
            self._rest = b""
        return ended


def check_until_end(query: LogQuery) -> None:
    """Raise DoraSystemdError (USAGE) for a query that --until-end cannot have."""
    if not query.name or query.others:
        which = "several" if query.others else "all"
        message = f"cannot wait for the end of {which} dataflows"
        raise usage_error(message, "say which dataflow: doractl logs NAME --until-end")
    if query.is_reverse:
        hint = "leave --reverse or --until-end out"
        raise usage_error("cannot follow with the newest lines first", hint)


def follow_to_end(query: LogQuery, print_query: Callable[[LogQuery], int]) -> int:
    """Print the records of a query, step by step, until its unit has ended.

    print_query: returns the exit status of journalctl, 1 if --grep matches nothing. Returns the
    lowest of all steps. Raises DoraSystemdError.
    """
    start_us = time.time_ns() // 1000
    bus = Bus(query.scope, for_reading=True)
    with (
        closing(UnitWatch(query.scope, query.name, start_us)) as watch,
        TemporaryDirectory(prefix="doractl-") as directory,
    ):
        steps, found = _steps(query, Path(directory) / "cursor", start_us), set[int]()

        def print_step() -> None:
            step = next(steps)
            status = print_query(step)
            # A step for which nothing was found goes without --grep.
            found.add(status if step.grep == query.grep else ExitCode.FAILURE)

        follow_steps(print_step, watch, lambda: is_unit_up(bus, query.name))
    return min(found)


def _steps(query: LogQuery, cursor: Path, start_us: int) -> Iterator[LogQuery]:
    yield _with_cursor(first_step(query, cursor), cursor)
    while True:
        yield _with_cursor(next_step(query, cursor, start_us), cursor)


def _with_cursor(query: LogQuery, cursor: Path) -> LogQuery:
    """Return the query for journalctl, which writes the cursor of its last record to a file.

    journalctl refuses --cursor-file with --since, and with --grep and --lines would write the
    cursor of the oldest record. For such a query find_span() first finds the records.
    """
    if not query.since and not (query.grep and query.is_counted):
        return query
    span = find_span(query)
    if span is None:
        # Without a cursor file journalctl would print "-- No entries --" at each step.
        return replace(query, tail="0", grep="", cursor_file="", is_quiet=True)
    cursor.write_text(f"{span.cursor}\n")
    return replace(query, tail="", since=span.first, until=span.last, cursor_file="")


def follow_steps(
    print_step: Callable[[], object],
    watch: Watch,
    is_up: Callable[[], bool],
    end_seconds: float = END_SECONDS,
) -> None:
    """Call `print_step` whenever there are new records, and once after the end.

    is_up: whether the unit runs or is about to. A record of its end alone does not count, because
    a restart writes one too; end_seconds: how long to wait for that record.
    """
    has_more = is_up()
    while True:
        printed = time.monotonic()
        print_step()
        if not has_more:
            return
        has_news = watch.wait(POLL_SECONDS)
        has_ended = watch.take_end()
        if has_ended or not has_news:
            has_more = is_up()
        if not (has_more or has_ended):
            _wait_end(watch, end_seconds)
        elif has_more and has_news:
            time.sleep(max(printed + STEP_SECONDS - time.monotonic(), 0))


def _wait_end(watch: Watch, seconds: float) -> None:
    """Wait for systemd's record of the unit's end, at most `seconds`."""
    deadline = time.monotonic() + seconds
    while not watch.take_end() and time.monotonic() < deadline:
        watch.wait(STEP_SECONDS)


def is_unit_up(manager: Manager, name: str) -> bool:
    """Whether the unit of a dataflow runs or has a queued job."""
    return not is_at_rest(manager.read(unit_name(name), ("ActiveState", "Job")))


def first_step(query: LogQuery, cursor: Path) -> LogQuery:
    """The query for the existing records. cursor: a file that does not exist yet."""
    is_bare = not query.tail and not query.since
    tail = str(FIRST_LINES) if is_bare else query.tail
    return replace(query, is_follow=False, tail=tail, cursor_file=str(cursor))


def next_step(query: LogQuery, cursor: Path, start_us: int) -> LogQuery:
    """The query for the records after the cursor, or since `start_us` (µs) without a cursor."""
    has_cursor = cursor.exists() and cursor.stat().st_size
    since = "" if has_cursor else journal_timestamp(start_us)
    return replace(query, is_follow=False, tail="", since=since, cursor_file=str(cursor))

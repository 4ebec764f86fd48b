"""`doractl logs` and `doractl run`: read the records of a dataflow from the journal."""

import contextlib
import errno
import math
import os
import select
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.journal.journalctl import (
    CHUNK,
    end_journalctl,
    journal_output,
    open_journalctl,
)
from dora_systemd.decisions.logs.lines import ExportReader
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
from dora_systemd.scope import Scope, config_home

_TURN = 1 << 14
"""Bytes of records between two checks for other events: a terminal may be slow."""
AGAIN_SECONDS = 1.0
"""Pause before another journalctl if one dies; it doubles."""
_MOST_SECONDS = 30.0
_FIELDS = ",".join((*LOG_FIELDS, "SYSLOG_IDENTIFIER"))

Write = Callable[[bytes], object]
_LEFT_OUT = b" blob data]\n"
"""What journalctl prints in the place of a message with control characters ends with this."""


def read_logs(
    query: LogQuery,
    terminal: TerminalLines | ShownLines,
    want_colors: bool = False,
    on_end: Callable[[int], object] | None = None,
) -> Iterator[bytes]:
    """The output of journalctl for a query, in chunks, formatted by `terminal`.

    on_end: as for journal_output(). Raises DoraSystemdError: USAGE for a time or pattern that
    journalctl does not accept.
    """
    # What commands a terminal is escaped here, so nothing need be left out.
    shown = replace(query, want_unprintable=True)
    arguments = query_arguments(_oldest_first(shown))
    for data in journal_output(arguments, want_colors, on_end):
        yield terminal.feed(data)
        if query.is_follow:
            yield terminal.flush()  # show received lines at once
    yield terminal.flush()


def pass_logs(query: LogQuery, fd: int, on_left_out: Callable[[], object] | None = None) -> int:
    """Write the records of a query to `fd` as journalctl prints them; its exit status.

    on_left_out: called once if journalctl has left out the text of a message.
    Raises DoraSystemdError as read_logs does, and OSError for `fd`: journalctl ignores a full disk.
    """
    with open_journalctl(query_arguments(_oldest_first(query))) as child:
        assert child.stdout
        while data := _read_for(fd, child.stdout.fileno()):
            write_whole(data, fd)
            if on_left_out is not None and _LEFT_OUT in data:
                on_left_out()
                on_left_out = None
        return end_journalctl(child)


def _read_for(fd: int, source: int) -> bytes:
    """Wait for the next bytes of `source`. Raises BrokenPipeError if nobody reads `fd` any more."""
    poll = select.poll()
    poll.register(source, select.POLLIN)
    poll.register(fd, 0)  # poll(2) reports the end of a reader in any case
    if fd in dict(poll.poll()):
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
    return os.read(source, CHUNK)


def write_whole(data: bytes, fd: int) -> None:
    """Write all of it. Raises OSError."""
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(fd, rest) :]


def _oldest_first(query: LogQuery) -> LogQuery:
    """Return the query for its records in the order of time, which --grep with --lines reverses."""
    if not (query.grep and query.is_counted) or query.is_follow or query.is_reverse:
        return query
    span = find_span(query)
    return query if span is None else replace(query, tail="", since=span.first, until=span.last)


class Span(NamedTuple):
    """A range of records in the journal."""

    # first, last: times for journalctl
    first: str
    last: str
    cursor: str  # of the last


def find_span(query: LogQuery) -> Span | None:
    """Find the range of the records of a query, None without records. Raises DoraSystemdError."""
    wanted = replace(query, output="export", cursor_file="", is_follow=False)
    if not query.is_counted:
        wanted = replace(wanted, tail="1")  # the last one, and --since is known
    arguments = ["--output-fields=MESSAGE_ID", *query_arguments(wanted)]
    reader, found = ExportReader(), list[tuple[int, str]]()
    for data in journal_output(arguments):
        found += [
            (int(one["__REALTIME_TIMESTAMP"]), one.get("__CURSOR", b"").decode())
            for one in reader.feed(data)
        ]
    if not found:
        return None
    (first, _), (last, cursor) = min(found), max(found, key=lambda one: one[0])
    begin = journal_timestamp(first) if query.is_counted else query.since
    return Span(begin, journal_timestamp(last), cursor)


class Follower:
    """A `journalctl --follow`, for poll(2), and the next one if it dies. Use contextlib.closing().

    since_us: CLOCK_REALTIME µs of the first records. outlives_interrupt: see open_journalctl().
    """

    _fd = -1

    def __init__(
        self, since_us: int, fields: str, matches: Sequence[str], outlives_interrupt: bool = False
    ) -> None:
        self._options = ["--follow", "--quiet", "--output=export", f"--output-fields={fields}"]
        self._begin = [f"--since={journal_timestamp(since_us)}"]
        self._matches = matches
        self._outlives_interrupt = outlives_interrupt
        self._stack = ExitStack()
        self._pause = AGAIN_SECONDS
        self._open()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)

    def _open(self) -> None:
        self._stack.close()
        self._due = math.inf
        arguments = [*self._options, *self._begin, "--", *self._matches]
        journalctl = open_journalctl(arguments, outlives_interrupt=self._outlives_interrupt)
        child = self._stack.enter_context(journalctl)
        assert child.stdout
        self._use(child.stdout.fileno())

    def _use(self, fd: int) -> None:
        """Read from `fd` under the number that others poll."""
        self._fd = os.dup(fd) if self._fd < 0 else os.dup2(fd, self._fd, inheritable=False)
        os.set_blocking(self._fd, False)

    def _lose(self) -> None:
        """Stop reading until the next journalctl, which starts after a growing pause."""
        self._stack.close()
        idle, other = os.pipe()
        self._use(idle)
        os.close(idle)
        self._stack.callback(os.close, other)
        self._due = time.monotonic() + self._pause
        self._pause = min(2 * self._pause, _MOST_SECONDS)

    def fileno(self) -> int:
        """Return a descriptor for poll(2): readable when there may be records."""
        return self._fd

    def is_readable(self, seconds: float) -> bool:
        """Wait at most `seconds`; whether there may be records."""
        if (pause := max(self._due - time.monotonic(), 0)) <= seconds:
            time.sleep(pause)
            self._open()
            seconds -= pause
        return bool(self._poll.poll(seconds * 1000))

    def read(self, size: int) -> bytes | None:
        """Read at most `size` bytes; None if there is nothing to read now."""
        if self._due <= time.monotonic():
            self._open()
        with suppress(BlockingIOError):
            if data := os.read(self._fd, size):
                return data
            self._lose()
        return None

    def close(self) -> None:
        """Terminate the journalctl process."""
        self._stack.close()
        os.close(self._fd)


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
        # After the first Ctrl+C the nodes may still write lines.
        super().__init__(since_us, _FIELDS, matches, outlives_interrupt=True)
        self.has_ended = False
        self._write = write
        self._form = form
        self._records = ExportReader()

    def _lose(self) -> None:
        super()._lose()
        self._records = ExportReader()  # without half a record

    def print_new(self) -> None:
        """Write some of the received lines: a flood of lines must not block the caller."""
        if data := self.read(_TURN):
            self._print(data)

    def _print(self, data: bytes) -> None:
        lines: list[bytes] = []
        for record in self._records.feed(data):
            if cursor := record.get("__CURSOR", b"").decode():
                self._begin = ["--no-tail", f"--after-cursor={cursor}"]
            # After an automatic restart more records follow.
            self.has_ended = record.get("MESSAGE_ID", b"").decode() in UNIT_ENDS
            if not self.has_ended:
                lines.append(self._form(record))
        if text := b"".join(lines):
            self._write(text)

    def finish(self, seconds: float = 3.0) -> None:
        """Write the remaining lines of a unit that has ended; wait at most `seconds`."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            if not self.is_readable(0 if self.has_ended else left):
                return
            self.print_new()


def unit_places(scope: Scope, environment: Mapping[str, str]) -> Iterator[Path]:
    """Yield the directories of transient and of enabled units, see systemd.unit(5)."""
    yield scope.transient_units
    if not scope.is_user:
        yield Path("/etc/systemd/system")
        return
    if config := config_home(environment):
        yield Path(config, "systemd/user")


def has_unit(places: Iterator[Path], prefix: str) -> bool:
    """Whether a unit in one of these directories has a name that begins so."""
    return any(_has_unit(one, prefix) for one in places)


def _has_unit(directory: Path, prefix: str) -> bool:
    with contextlib.suppress(OSError), os.scandir(directory) as entries:
        return any(one.name.startswith(prefix) for one in entries)
    return False

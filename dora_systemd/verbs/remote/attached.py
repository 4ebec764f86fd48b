"""`start --attach` of a dataflow on several machines: the lines of its nodes on the others, too.

Each machine sends its own journal by ssh, with a new connection after each loss as long as the
dataflow runs. An unreachable machine is reported once, and does not stop the others. Of a machine
only records of its own nodes count.
"""

import select
import time
from collections.abc import Callable, Iterator, Sequence

from dora_systemd.decisions.logs.query import journal_timestamp
from dora_systemd.decisions.logs.records import Record, record_text
from dora_systemd.decisions.remote.hosts import Host, Way
from dora_systemd.decisions.remote.merge import TIME, Records
from dora_systemd.decisions.remote.ssh_failures import too_much
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.logs import FollowedLog
from dora_systemd.verbs.remote.talk import Ended, Said, Talk

_PAUSES = (0.5, 5.0)
"""Seconds before the next attempt: the part there is not begun yet, or the machine is away."""
_TURNS = 16
"""Reads at one look: a flood of lines must not keep the caller here."""
_LAST_SECONDS, _QUIET_SECONDS, _LOOK_SECONDS = 2.0, 0.7, 0.05
"""Time for the last lines of an ended dataflow, and the silence after which none are expected."""
_EARLIER = 1_000_000
"""µs: clocks of machines differ."""


class MemberLines:
    """The lines of the nodes of one machine, from `since_us` (CLOCK_REALTIME) on.

    warn: called once with the reason if there are no lines. pauses: as _PAUSES.
    """

    def __init__(
        self,
        host: Host,
        dataflow: tuple[str, str],
        nodes: Sequence[str],
        since_us: int,
        warn: Callable[[str], object],
        pauses: tuple[float, float] = _PAUSES,
    ) -> None:
        self._host, self._nodes, self._warn = host, frozenset(nodes), warn
        self._name, self._uuid = dataflow
        self._soon, self._later = pauses
        self._since = since_us - _EARLIER
        self._records = Records()
        self._talk: Talk | None = None
        self._due, self._has_warned = 0.0, False

    def look(self) -> Iterator[Record]:
        """Yield the received lines, without waiting."""
        if self._talk is None:
            if time.monotonic() >= self._due:
                self._begin()
            return
        connection = self._talk.connection
        self._talk.take(connection.errors)
        for _ in range(_TURNS):
            said = self._talk.take(connection.output)
            if said is None:
                break
            yield from self._told(said)
        if _is_over(connection.ended):
            yield from self._end(self._talk.end())
            return
        if self._records.is_too_much:
            self._talk.refuse(too_much(self._host))
        if self._talk.is_over(time.monotonic()):
            yield from self._end([self._talk.give_up()])

    def close(self) -> None:
        """End what follows there."""
        if self._talk is not None:
            self._talk.connection.hang_up()
            self._talk.connection.close()
            self._talk = None
        self._due = float("inf")

    def _begin(self) -> None:
        since = f"--since={journal_timestamp(self._since)}"
        words = ("logs", self._name, "--machine=head", "-f", since, "-a", "-q", "-o", "export")
        self._records = Records()
        try:
            self._talk = Talk(self._host, Way.FOLLOWING, words, None)
        except DoraSystemdError as error:  # there is no ssh
            self._lose(Ended(self._host, error.code, error))

    def _end(self, events: "Iterator[Said | Ended] | list[Ended]") -> Iterator[Record]:
        for event in events:
            if isinstance(event, Said):
                yield from self._told([event])
            else:
                self._lose(event)

    def _lose(self, ended: Ended) -> None:
        self._talk = None
        is_early = ended.error is None and ended.status == ExitCode.NOT_FOUND
        self._due = time.monotonic() + (self._soon if is_early else self._later)
        if not is_early and not self._has_warned:
            self._has_warned = True
            why = ended.error.message if ended.error else f"exit status {ended.status}"
            self._warn(f"the lines of machine {self._host.text} are missing for now: {why}")

    def _told(self, said: Sequence[Said]) -> Iterator[Record]:
        for one in said:
            for record in self._records.exported(one.data) if not one.is_error else ():
                if self._is_ours(record):
                    self._since = max(self._since, int(record[TIME]) + 1)
                    self._has_warned = False
                    identifier = f"{self._name}/{record_text(record, 'DORA_NODE')}"
                    yield {**record, "SYSLOG_IDENTIFIER": identifier.encode()}

    def _is_ours(self, record: Record) -> bool:
        """Whether it is a line of a node there; events are in the journal of the head as well."""
        is_own = record_text(record, "DORA_DATAFLOW") == self._uuid
        is_line = "DORA_EVENT" not in record and record_text(record, "DORA_NODE") in self._nodes
        return is_own and is_line


def _is_over(pidfd: int) -> bool:
    return bool(select.select([pidfd], [], [], 0)[0])


class SharedLog:
    """The lines of the head, and those of its members; as FollowedLog.

    others: the lines of the members, which are known when the unit has been started.
    """

    def __init__(
        self, head: FollowedLog, write: Callable[[bytes], object], form: Callable[[Record], bytes]
    ) -> None:
        self._head, self._write, self._form = head, write, form
        self.others: Sequence[MemberLines] = ()

    def fileno(self) -> int:
        """Return the descriptor of the head's lines: a poller checks the others periodically."""
        return self._head.fileno()

    def print_new(self) -> None:
        self._head.print_new()
        self._look()

    def _look(self) -> bool:
        lines = [self._form(record) for one in self.others for record in one.look()]
        if text := b"".join(lines):
            self._write(text)
        return bool(lines)

    def finish(self) -> None:
        self._head.finish()
        begun = last = time.monotonic()
        while self.others and (now := time.monotonic()) < min(
            begun + _LAST_SECONDS, last + _QUIET_SECONDS
        ):
            last = now if self._look() else last
            time.sleep(_LOOK_SECONDS)

    def close(self) -> None:
        """End all that follows."""
        for one in self.others:
            one.close()
        self._head.close()

"""Reads the journal records of other hosts, and puts them into one order. Pure: the time is given.

A host can lie about its records, and about their times.
"""

import heapq
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.logs.lines import ExportReader
from dora_systemd.decisions.remote.stream import Lines, read_json

WINDOW_SECONDS = 0.6
"""How long a followed record waits for older ones of other hosts: journald and ssh take up to half
a second."""
MOST_HELD = 2000
"""Records of one host that are held: more of them stay in its pipe."""
MOST_BYTES = 16 << 20
"""Bytes of one host's records that are held."""


class Held(NamedTuple):
    """A record, in the order in which it is printed."""

    key: int  # its time, negative for newest first
    number: int
    host: str
    arrived: float  # in seconds of the clock of the caller
    data: bytes  # what is printed of it


class Merge:
    """The records of several hosts. is_follow: whether they come as they are written."""

    def __init__(self, hosts: Sequence[str], is_follow: bool, is_reverse: bool = False) -> None:
        self._open = set(hosts)
        self._is_follow = is_follow
        self._sign = -1 if is_reverse else 1
        self._heap: list[Held] = []
        self._counts: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self._numbers = itertools.count()

    def add(self, host: str, at_us: int, data: bytes, now: float) -> None:
        """Take a record. at_us: when it was written, CLOCK_REALTIME µs of that host."""
        held = Held(self._sign * at_us, next(self._numbers), host, now, data)
        heapq.heappush(self._heap, held)
        self._counts[host] += 1
        self._bytes[host] += len(data)

    def end(self, host: str) -> None:
        """No more will come from that host."""
        self._open.discard(host)

    def begin(self, host: str) -> None:
        """More will come from that host."""
        self._open.add(host)

    def is_full(self, host: str) -> bool:
        """Whether enough of that host is held."""
        return self._counts[host] >= MOST_HELD or self._bytes[host] >= MOST_BYTES

    @property
    def is_empty(self) -> bool:
        """Whether nothing is held."""
        return not self._heap

    def take(self, now: float, is_complete: bool = True) -> Iterator[Held]:
        """The records whose turn it is.

        is_complete: whether every host has been reached or given up.
        """
        while self._heap and is_complete and self._is_due(now):
            held = heapq.heappop(self._heap)
            self._counts[held.host] -= 1
            self._bytes[held.host] -= len(held.data)
            yield held

    def _is_due(self, now: float) -> bool:
        if not self._open:
            return True
        if self._is_follow:
            return now - self._heap[0].arrived >= WINDOW_SECONDS or self._is_flooded()
        return all(self._counts[host] for host in self._open)

    def _is_flooded(self) -> bool:
        """Whether the buffer of a host is full, so that one of its records must be printed."""
        return self.is_full(self._heap[0].host)


TIME = "__REALTIME_TIMESTAMP"
_MOST_BYTES = 4 << 20
"""Maximum bytes of a record that is not complete."""
_MOST_TIME = 253_370_764_800_000_000
"""The year 9999, in µs."""


class Records:
    """The records of one host, from its output. Each has its time and what is printed of it."""

    def __init__(self) -> None:
        self._pending = 0
        self._has_data = self._has_record = False
        self._reader = ExportReader()
        self._lines = Lines()

    @property
    def is_unreadable(self) -> bool:
        """Whether there was output, and no record in it."""
        return self._has_data and not self._has_record

    @property
    def is_too_much(self) -> bool:
        """Whether a record is larger than any."""
        return self._pending > _MOST_BYTES

    def exported(self, data: bytes) -> list[dict[str, bytes]]:
        """The records that `data` completes, in the export format, with times that can be."""
        found = self._reader.feed(data)
        self._pending = 0 if found else self._pending + len(data)
        self._has_data |= bool(data)
        self._has_record |= bool(found)
        for record in found:
            record[TIME] = b"%d" % time_of(record.get(TIME))
        return found

    def objects(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The objects that `data` completes, of -o json."""
        self._has_data |= bool(data)
        for line in self._lines.feed(data):
            if isinstance(value := read_json(line), dict):
                self._has_record = True
                yield value


def time_of(value: object) -> int:
    """Parse a time of the journal in µs; 0 for an invalid one."""
    try:
        number = int(value) if isinstance(value, str | bytes) else 0
    except ValueError:
        return 0
    return number if 0 <= number <= _MOST_TIME else 0

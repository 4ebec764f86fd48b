"""Puts the records of several hosts into one order. Pure: the time is given."""

import heapq
import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

WINDOW_SECONDS = 0.6
"""How long a followed record waits for older ones of other hosts: journald and ssh take up to half
a second."""
MOST_HELD = 2000
"""Records of one host that are held: more of them stay in its pipe."""
MOST_BYTES = 16 << 20
"""The same, in bytes."""


class Held(NamedTuple):
    """A record, in the order in which it is printed. key: its time, negative for newest first.

    arrived: in seconds of the clock of the caller. data: what is printed of it.
    """

    key: int
    number: int
    host: str
    arrived: float
    data: bytes


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
        """Whether a host cannot go on before something of it is printed."""
        return self.is_full(self._heap[0].host)

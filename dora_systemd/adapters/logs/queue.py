"""Orders the entries that journald does not take at once.

Each node has a lane, first in, first out. While a lane waits, `pause` keeps the node's pipes from
being read, so lines do not pile up here; records that the runner writes itself are bounded by
MAX_RECORDS. An event of the whole dataflow waits for every lane that was not empty when the event
was put. Lanes take turns: each flush begins with another one, and lanes of a flood use send_bulk,
which leaves room in journald's queue for the others.

An item is a function that makes its entries, and the queue calls it when it is the item's turn.
So a waiting item costs the bytes read from the pipe, and not the larger journal entries. Calling
such a function out of order, or twice, would break this: it feeds a line splitter.
The queue has no I/O of its own except through the given Journal, and belongs to one thread.
"""

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

# Lines cannot pile up because `pause` stops reading their pipes; records of the runner could.
MAX_RECORDS = 20_000
NOTE_EVERY = 16
"""Entries between two calls of a Note: a kill of the runner repeats at most so many lines."""

MakeEntries = Callable[[], list[bytes]]
Note = Callable[[int], object]
"""Called with the number of entries of an item still waiting: now and then, when a send pauses, and
with 0 when it completes."""


class Journal(Protocol):
    """The part of dora_systemd.adapters.journal.socket.JournalSocket that LogQueue uses."""

    def send(self, entry: bytes) -> bool:
        """Send one entry; False if journald did not take it."""

    def send_bulk(self, entry: bytes) -> bool:
        """Send one entry of a flood; False if journald did not take it."""

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        """From now on call `callback` each time a refused entry may be sent again."""

    def wait_ready(self, seconds: float) -> None:
        """Block until a refused entry may be sent again, at most `seconds`."""


def _ignore(left: int) -> None:
    """Do nothing, for items without a Note."""


@dataclass
class _Lane:
    """The entries of one node that journald has not taken yet."""

    items: deque[tuple[MakeEntries, Note]] = field(default_factory=deque)
    # Entries of the current item in reverse order, because pop() at the end is cheap.
    entries: list[bytes] = field(default_factory=list)
    note: Note = _ignore
    is_flood: bool = False
    # Records put since the lane was last empty, see put_record.
    records: int = 0

    @property
    def waiting(self) -> int:
        """Number of waiting items, including the current one."""
        return len(self.items) + bool(self.entries)


@dataclass
class _Event:
    """An event of the whole dataflow."""

    entry: bytes
    behind: set[str]  # nodes whose earlier entries must be sent first


class LogQueue:
    """Entries on their way to journald.

    pause, resume: called with a node whose pipes must not be read, or may be read again.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        journal: Journal,
        pause: Callable[[str], None],
        resume: Callable[[str], None],
        max_records: int = MAX_RECORDS,
    ) -> None:
        self._journal = journal
        self._pause = pause
        self._resume = resume
        self._max_records = max_records
        self._lanes: defaultdict[str, _Lane] = defaultdict(_Lane)
        self._events: deque[_Event] = deque()
        self._turn = 0
        self._lost = 0
        journal.call_when_ready(loop, self.flush)

    def put(
        self, node: str, make_entries: MakeEntries, is_flood: bool = False, note: Note = _ignore
    ) -> None:
        """Send the entries of a node after its earlier ones, now or as soon as journald can."""
        lane = self._lanes[node]
        was_waiting = lane.waiting
        lane.items.append((make_entries, note))
        if was_waiting:
            return
        lane.is_flood = is_flood
        if not self._send(lane):
            self._pause(node)

    def put_record(self, node: str, entry: bytes) -> None:
        """Send one entry that no paused pipe holds back; above max_records count it as lost."""
        lane = self._lanes[node]
        if lane.records >= self._max_records:
            self._lost += 1
            return
        lane.records += 1
        self.put(node, lambda: [entry])

    def put_event(self, entry: bytes) -> None:
        """Send an entry after all entries of all nodes that were put before it."""
        if len(self._events) >= self._max_records:
            self._lost += 1
            return
        behind = {node for node, lane in self._lanes.items() if lane.waiting}
        self._events.append(_Event(entry, behind))
        self._send_events()

    def waiting(self, node: str) -> int:
        """Number of waiting items of a node."""
        return self._lanes[node].waiting

    @property
    def is_empty(self) -> bool:
        """Whether journald has taken everything."""
        return not self._events and not any(lane.waiting for lane in self._lanes.values())

    def flush(self) -> None:
        """Continue where journald refused an entry; the callback of call_when_ready."""
        stopped = [node for node, lane in self._lanes.items() if lane.waiting]
        shift = self._turn % max(len(stopped), 1)
        self._turn += 1
        for node in stopped[shift:] + stopped[:shift]:
            if self._send(self._lanes[node]):
                self._emptied(node)
        self._send_events()

    def give_up(self) -> int:
        """Discard what waits; returns the number of these entries plus take_lost()."""
        waiting = len(self._events)
        for lane in self._lanes.values():
            waiting += len(lane.entries) + sum(
                len(make_entries()) for make_entries, _ in lane.items
            )
        self._lanes.clear()
        self._events.clear()
        return waiting + self.take_lost()

    def take_lost(self) -> int:
        """Number of records that put_record() and put_event() dropped since the last call."""
        lost, self._lost = self._lost, 0
        return lost

    def _send(self, lane: _Lane) -> bool:
        send = self._journal.send_bulk if lane.is_flood else self._journal.send
        entries, items = lane.entries, lane.items
        while entries or items:
            if not entries:
                make_entries, lane.note = items.popleft()
                entries += reversed(make_entries())
            while entries:
                if not send(entries[-1]):
                    lane.note(len(entries))
                    return False
                entries.pop()
                if entries and not len(entries) % NOTE_EVERY:
                    lane.note(len(entries))
            lane.note(0)
        lane.records = 0
        return True

    def _emptied(self, node: str) -> None:
        for event in self._events:
            event.behind.discard(node)
        self._resume(node)

    def _send_events(self) -> None:
        while self._events and not self._events[0].behind:
            if not self._journal.send(self._events[0].entry):
                return
            self._events.popleft()

"""The order in which entries go to journald when it does not take them at once.

Per node first in, first out; an event of the whole dataflow comes after all that was put before
it. Nodes take turns, so a flood does not keep the others waiting. Entries are made when it is
their turn: what waits is what came out of the pipes. Pure but for the journal that it is given.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

# Lines cannot pile up, their pipes are not read meanwhile; records made by the runner could.
MAX_RECORDS = 20_000

MakeEntries = Callable[[], list[bytes]]
Note = Callable[[int], object]
"""Is told how many entries of an item wait, when some of them or all have been taken."""


class Journal(Protocol):
    """What is needed of dora_systemd.adapters.journal.socket.JournalSocket."""

    def send(self, entry: bytes) -> bool:
        """Send one entry, False if it was not taken."""

    def send_bulk(self, entry: bytes) -> bool:
        """Send one entry of a flood, False if it was not taken."""

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        """Call `callback` when a refused entry may be sent again."""

    def wait_ready(self, seconds: float) -> None:
        """Block until then, at most `seconds`."""


def _ignore(left: int) -> None:
    """For what nobody asks about."""


@dataclass
class _Lane:
    """The entries of one node that journald has not taken yet."""

    items: deque[tuple[MakeEntries, Note]] = field(default_factory=deque)
    # The entries of the item whose turn it is, last one first.
    entries: list[bytes] = field(default_factory=list)
    note: Note = _ignore
    is_flood: bool = False
    # How many of the items are records, see put_record.
    records: int = 0

    @property
    def waiting(self) -> int:
        """How many items wait, a begun one included."""
        return len(self.items) + bool(self.entries)


@dataclass
class _Event:
    """An event of the whole dataflow, and the nodes whose earlier entries come before it."""

    entry: bytes
    behind: set[str]


class LogQueue:
    """Entries on their way to journald.

    pause, resume: called with a node when its lines are not wanted for now, and wanted again.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        journal: Journal,
        pause: Callable[[str], None],
        resume: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._journal = journal
        self._pause = pause
        self._resume = resume
        self._lanes: dict[str, _Lane] = {}
        self._events: deque[_Event] = deque()
        self._turn = 0
        self._lost = 0

    def put(
        self, node: str, make_entries: MakeEntries, is_flood: bool = False, note: Note = _ignore
    ) -> None:
        """Send the entries of a node after its earlier ones, now or as soon as possible."""
        lane = self._lanes.setdefault(node, _Lane())
        was_waiting = lane.waiting
        lane.items.append((make_entries, note))
        if was_waiting:
            return
        lane.is_flood = is_flood
        if not self._send(lane):
            self._pause(node)
            self._journal.call_when_ready(self._loop, self.flush)

    def put_record(self, node: str, entry: bytes) -> None:
        """The same for an entry that no pipe holds back: above MAX_RECORDS it is only counted."""
        lane = self._lanes.setdefault(node, _Lane())
        if lane.records >= MAX_RECORDS:
            self._lost += 1
            return
        lane.records += 1
        self.put(node, lambda: [entry])

    def put_event(self, entry: bytes) -> None:
        """Send an entry after all that were put before it, of whatever node."""
        if len(self._events) >= MAX_RECORDS:
            self._lost += 1
            return
        behind = {node for node, lane in self._lanes.items() if lane.waiting}
        self._events.append(_Event(entry, behind))
        if not self._send_events():
            self._journal.call_when_ready(self._loop, self.flush)

    def waiting(self, node: str) -> int:
        """How many items of a node wait."""
        lane = self._lanes.get(node)
        return lane.waiting if lane else 0

    @property
    def is_empty(self) -> bool:
        """Whether journald has been given everything."""
        return not self._events and not any(lane.waiting for lane in self._lanes.values())

    def flush(self) -> None:
        """Go on where journald stopped to take entries."""
        stopped = [node for node, lane in self._lanes.items() if lane.waiting]
        shift = self._turn % max(len(stopped), 1)
        self._turn += 1
        for node in stopped[shift:] + stopped[:shift]:
            if self._send(self._lanes[node]):
                self._emptied(node)
        self._send_events()
        if not self.is_empty:
            self._journal.call_when_ready(self._loop, self.flush)

    def give_up(self) -> int:
        """Forget what waits; how many entries that were, with those counted before."""
        waiting = len(self._events)
        for lane in self._lanes.values():
            waiting += len(lane.entries) + sum(
                len(make_entries()) for make_entries, _ in lane.items
            )
        self._lanes.clear()
        self._events.clear()
        return waiting + self.take_lost()

    def take_lost(self) -> int:
        """How many records were not taken since the last call, see `put_record`."""
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
            lane.note(0)
        lane.records = 0
        return True

    def _emptied(self, node: str) -> None:
        for event in self._events:
            event.behind.discard(node)
        self._resume(node)

    def _send_events(self) -> bool:
        while self._events and not self._events[0].behind:
            if not self._journal.send(self._events[0].entry):
                return False
            self._events.popleft()
        return True

"""Writes messages into a ring, in a process of the nodes' Python, see ring.py."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    MOST_SCHEMA,
    RECORD_SIZE,
    SCHEMA_AT,
    SMALL,
    STATE_SIZE,
    Header,
    Part,
    RecordHead,
    State,
    Store,
    format_record,
    format_state,
    parse_header,
    parse_record,
    read_state,
    read_tape,
    state_at,
    tape_at,
)


class Tape:
    """The writer's side of one output. page: bytes of this machine's pages."""

    def __init__(self, store: Store, header: Header, at: int, page: int) -> None:
        self._store, self._header, self._at, self._page = store, header, at, page
        self._base, self._span = tape_at(header, at), header.span
        self.messages: deque[tuple[int, int, int]] = deque()
        """Of each: bytes of the record, CLOCK_BOOTTIME, bytes of its data."""
        try:
            state, self.schema = read_state(store, at)
            self.number = self._restore(state)
        except ValueError:  # another program has written there
            state, self.schema, self.number = State(), b"", 0
            self.messages.clear()
        self._tail, self._head, self.received, self.dropped = state[:4]
        self.evicted, self.too_large, self.largest, self._version = state[4:]
        self.used = self.used_with(0)
        """Bytes of the pages that the window takes."""
        self._clean()

    def _restore(self, state: State) -> int:
        """Learn what an earlier recorder has written; return the number of its last message."""
        position, head, number = state.tail, state.head, 0
        if not 0 <= head - position <= self._header.budget:
            raise ValueError("its window is impossible")
        while position < head:
            data = read_tape(self._store, self._header, self._at, position, RECORD_SIZE)
            one, _ = parse_record(data, head - position)
            self.messages.append((one.size, one.steady_ns, one.data_size))
            position, number = position + one.size, one.number
        return number

    def _clean(self) -> None:
        """Make holes of all but the window: a recorder can be killed before it does."""
        self.commit()
        low, high = self._down(self._tail), self._down(self._head + self._page - 1)
        self._punch(high, low + self._span)

    def _down(self, position: int) -> int:
        return position - position % self._page

    def used_with(self, size: int) -> int:
        """Bytes of the pages that the window takes with one more record."""
        if not self.messages and not size:
            return 0
        return self._down(self._head + size + self._page - 1) - self._down(self._tail)

    def commit(self) -> None:
        """Write the state."""
        self._version = version = self._version + 1
        state = State(
            *(self._tail, self._head, self.received, self.dropped),
            *(self.evicted, self.too_large, self.largest, version),
        )
        place = state_at(self._at) + version % 2 * STATE_SIZE
        self._store.write(place, [format_state(state, self.schema)])

    def drop_oldest(self) -> None:
        """Give up the oldest message, and the pages that only it used.

        The next commit() writes that, unless pages have to go: no reader finds a hole in a window.
        """
        size, *_ = self.messages.popleft()
        before, tail = self._down(self._tail), self._tail + size
        after = self._down(tail if self.messages else tail + self._page - 1)
        self._tail, self.used = tail, self.used - after + before
        if after > before:
            self.commit()
            self._punch(before, after)

    def _punch(self, low: int, high: int) -> None:
        if high <= low:
            return
        place = low % self._span
        first = min(high - low, self._span - place)
        self._store.punch(self._base + place, first)
        if high - low > first:
            self._store.punch(self._base, high - low - first)

    def append(self, head: RecordHead, parts: Sequence[Part]) -> None:
        """Write a message; there has to be room for it."""
        place = self._head % self._span
        parts = [format_record(head, parts), *parts]
        if place + head.size <= self._span:
            self._store.write(self._base + place, parts)
        else:
            data, left = b"".join(map(bytes, parts)), self._span - place
            self._store.write(self._base + place, [data[:left]])
            self._store.write(self._base, [data[left:]])
        self.messages.append((head.size, head.steady_ns, head.data_size))
        self._head += head.size
        self.used = self.used_with(0)
        self.commit()

    def has(self, schema: bytes) -> bool:
        """Whether the schema is that of the state, which the first message decides."""
        if not self.schema and len(schema) <= MOST_SCHEMA:
            self._store.write(state_at(self._at) + SCHEMA_AT, [schema])
            self.schema = schema
        return schema == self.schema


class Message(NamedTuple):
    """What the recorder has received."""

    schema: bytes  # an Arrow IPC message, as meta and data
    meta: bytes  # JSON
    data: Part  # an Arrow IPC message
    received_ns: int  # CLOCK_REALTIME
    steady_ns: int  # CLOCK_BOOTTIME
    sent_ns: int


class Writer:
    """Writes messages into a ring, within its budget. There is one writer at a time."""

    def __init__(self, store: Store, page: int) -> None:
        self.header = parse_header(store.read(0, ALIGN))
        count = len(self.header.outputs)
        self.tapes = [Tape(store, self.header, at, page) for at in range(count)]
        self._number = max(one.number for one in self.tapes)
        self._used = sum(one.used for one in self.tapes)
        self._page = page

    @property
    def used(self) -> int:
        """Bytes that all tapes use."""
        return self._used

    def put(self, at: int, message: Message, dropped: int = 0) -> None:
        """Write a message of the output number `at`. dropped: messages lost before this one."""
        tape, (schema, meta, data, received, steady, sent) = self.tapes[at], message
        tape.received += 1
        tape.dropped += dropped
        own, data_size = b"" if tape.has(schema) else schema, len(data)
        sizes = len(own), len(meta), data_size
        size = (RECORD_SIZE + sum(sizes) + 7) // 8 * 8
        if not self._make_room(tape, size, steady):
            tape.largest = max(tape.largest, data_size)
            tape.too_large += 1
            tape.commit()
            return
        self._number += 1
        before = tape.used
        parts = [one for one in (own, meta, data) if len(one)]
        tape.append(RecordHead(size, self._number, received, steady, sent, *sizes), parts)
        self._used += tape.used - before
        if self.header.only_small and data_size > SMALL:
            while len(tape.messages) > 1:
                self._drop(tape)

    def _make_room(self, tape: Tape, size: int, now: int) -> bool:
        """Drop messages until there is room for a record; whether there is.

        The last message of each output stays, that of `tape` until the new one is written.
        """
        while len(tape.messages) > 1 and tape.messages[0][1] < now - self.header.last:
            self._drop(tape)
        while self._used - tape.used + tape.used_with(size) > self.header.budget:
            victim = self._largest(tape, size)
            if victim is None:
                return False
            victim.evicted += 1
            self._drop(victim)
        return True

    def _largest(self, tape: Tape, size: int) -> "Tape | None":
        """The output that uses most, of those that have more than their last message."""
        some = [one for one in self.tapes if len(one.messages) > 1]
        if not some:
            return None
        return max(some, key=lambda one: one.used_with(size) if one is tape else one.used)

    def _drop(self, tape: Tape) -> None:
        before = tape.used
        tape.drop_oldest()
        self._used += tape.used - before

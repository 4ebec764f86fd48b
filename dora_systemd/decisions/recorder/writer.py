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
        self.messages: deque[tuple[int, int, int]] = deque()
        """Of each: bytes of the record, CLOCK_BOOTTIME, bytes of its data."""
        try:
            self.state, self.schema = read_state(store, at)
            self.number = self._restore()
        except ValueError:  # another program has written there
            self.state, self.schema, self.number = State(), b"", 0
            self.messages.clear()
        self._clean()

    def _restore(self) -> int:
        """Learn what an earlier recorder has written; return the number of its last message."""
        position, head, number = self.state.tail, self.state.head, 0
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
        low, high = self._down(self.state.tail), self._down(self.state.head + self._page - 1)
        self._punch(high, low + self._header.span)

    def _down(self, position: int) -> int:
        return position - position % self._page

    @property
    def used(self) -> int:
        """Bytes of the pages that the window takes."""
        return self.used_with(0)

    def used_with(self, size: int) -> int:
        """Bytes of the pages that the window takes with one more record."""
        if not self.messages and not size:
            return 0
        high = self.state.head + size + self._page - 1
        return self._down(high) - self._down(self.state.tail)

    def commit(self) -> None:
        """Write the state."""
        version = self.state.version + 1
        self.state = self.state._replace(version=version)
        place = state_at(self._at) + version % 2 * STATE_SIZE
        self._store.write(place, [format_state(self.state, self.schema)])

    def count(self, **more: int) -> None:
        """Add to counters of the state, which the next commit() writes."""
        fields = {key: getattr(self.state, key) + value for key, value in more.items()}
        self.state = self.state._replace(**fields)

    def drop_oldest(self) -> None:
        """Give up the oldest message, and the pages that only it used."""
        size, *_ = self.messages.popleft()
        before, tail = self._down(self.state.tail), self.state.tail + size
        self.state = self.state._replace(tail=tail)
        self.commit()  # first, so that no reader finds a hole in the window
        after = self._down(tail if self.messages else tail + self._page - 1)
        self._punch(before, after)

    def _punch(self, low: int, high: int) -> None:
        base, span = tape_at(self._header, self._at), self._header.span
        if high <= low:
            return
        place = low % span
        first = min(high - low, span - place)
        self._store.punch(base + place, first)
        if high - low > first:
            self._store.punch(base, high - low - first)

    def append(self, head: RecordHead, parts: Sequence[Part]) -> None:
        """Write a message; there has to be room for it."""
        span, place = self._header.span, self.state.head % self._header.span
        parts = [format_record(head, parts), *parts]
        base = tape_at(self._header, self._at)
        if place + head.size <= span:
            self._store.write(base + place, parts)
        else:
            data = b"".join(map(bytes, parts))
            self._store.write(base + place, [data[: span - place]])
            self._store.write(base, [data[span - place :]])
        self.messages.append((head.size, head.steady_ns, head.data_size))
        self.state = self.state._replace(head=self.state.head + head.size)
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
        tape, data_size = self.tapes[at], memoryview(message.data).nbytes
        tape.count(received=1, dropped=dropped)
        schema = b"" if tape.has(message.schema) else message.schema
        parts = [one for one in (schema, message.meta, message.data) if len(one)]
        sizes = len(schema), len(message.meta), data_size
        size = (RECORD_SIZE + sum(sizes) + 7) // 8 * 8
        if not self._make_room(tape, size, message.steady_ns):
            largest = max(tape.state.largest, data_size)
            tape.state = tape.state._replace(largest=largest)
            tape.count(too_large=1)
            tape.commit()
            return
        self._number += 1
        times = message.received_ns, message.steady_ns, message.sent_ns
        before = tape.used
        tape.append(RecordHead(size, self._number, *times, *sizes), parts)
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
            victim.count(evicted=1)
            self._drop(victim)
        return True

    def _largest(self, tape: Tape, size: int) -> "Tape | None":
        """The output that uses most, of those that have more than their last message."""
        some = [one for one in self.tapes if len(one.messages) > 1]
        if not some:
            return None
        return max(some, key=lambda one: one.used_with(size if one is tape else 0))

    def _drop(self, tape: Tape) -> None:
        before = tape.used
        tape.drop_oldest()
        self._used += tape.used - before

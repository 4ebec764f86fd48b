"""Reads a ring, while its recorder writes to it or after the end of that.

The nodes' user can write to the ring. A reader reads at most `most` bytes of messages, the newest,
believes no length, and gives up a tape at the first record that is none. What it returns is bytes
and numbers; only pictures.py interprets Arrow.
"""

import heapq
from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple, Protocol

from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    RECORD,
    RECORD_SIZE,
    SMALL,
    Header,
    RecordHead,
    State,
    crc_of,
    parse_header,
    parse_record,
    read_state,
    read_tape,
    size_of,
)

MOST_RECORDS = 2_000_000
"""Messages that are read: reading as many takes half a minute."""
_TRIES = 8
"""Reads of a state that its recorder writes at the same time."""


class Source(Protocol):
    """The file of a ring, for readers."""

    def read(self, at: int, size: int) -> bytes:
        """Read; what is a hole is 0, and less comes at the end of the file."""


class Recorded(NamedTuple):
    """One message of a ring."""

    output: int  # its place in the outputs of the header
    head: RecordHead
    schema: bytes
    meta: bytes
    data: bytes


class Reading:
    """A ring, read once from its oldest message to its last. Raises ValueError for no ring.

    size: bytes of the file. most: bytes of messages that are read. records: number of them, and
    as many more to find the last ones of outputs.
    """

    def __init__(self, source: Source, size: int, most: int, records: int = MOST_RECORDS) -> None:
        self._source = source
        self.header: Header = parse_header(source.read(0, ALIGN))
        if size != size_of(self.header):
            raise ValueError("its size does not fit its header")
        self._states = [self._state(at) for at in range(len(self.header.outputs))]
        windows = sum(max(one.head - one.tail, 0) for one in self.states)
        if windows > self.header.budget:
            raise ValueError("it has more than its budget")
        self._most, self._skipped = most, max(windows - most, 0)
        self._records, self._left = records, 2 * records
        self.damaged = 0
        """Messages that could not be read, at least."""
        self.is_cut = False
        """Whether there was more than `most`."""

    @property
    def states(self) -> list[State]:
        """The states of all outputs when the reading began."""
        return [state for state, _ in self._states]

    def _state(self, at: int) -> tuple[State, bytes]:
        for _ in range(_TRIES):
            try:
                return read_state(self._source, at)
            except ValueError:
                continue
        return State(), b""

    def messages(self) -> Iterator[Recorded]:
        """All messages, in the order in which the recorder has received them."""
        seen, count = set[int](), 0
        tapes = (self._walk(at, state) for at, state in enumerate(self.states))
        for output, head, position, crc in heapq.merge(*tapes, key=lambda one: one[1].number):
            count += 1
            if count > self._records:
                self.is_cut = True
                break
            if self._skipped > 0:
                self._skipped -= head.size
                self.is_cut = True
                continue
            if message := self._message(output, head, position, crc):
                seen.add(output)
                yield message
            elif self._tail(output) <= position:
                self.damaged += 1
        for output in range(len(self._states)):
            # Those of an output that has few can have been replaced meanwhile, or are the oldest.
            if output not in seen and (message := self.newest(output)):
                yield message

    def metadata(self, at: int) -> bytes:
        """The metadata of the oldest message of one output, b"" for none, or too many bytes."""
        for _, head, position, _ in islice(self._walk(at, self._state(at)[0]), 1):
            start = position + RECORD_SIZE + head.schema_size
            if head.meta_size <= self._most:
                return read_tape(self._source, self.header, at, start, head.meta_size)
        return b""

    def newest(self, at: int, most: int = MOST_RECORDS) -> Recorded | None:
        """The last message of one output; None for none, and if it has more than `most`."""
        before = None
        for _ in range(_TRIES):
            if (state := self._state(at)[0]) == before:
                return None  # it is damaged, and not given up meanwhile
            before = state
            last = deque(enumerate(islice(self._walk(at, state), most + 1)), maxlen=1)
            for count, (output, head, position, crc) in last:
                if head.size > self._most or count == most or self._left <= 0:
                    return None
                if message := self._message(output, head, position, crc):
                    return message
        return None

    def _walk(self, at: int, state: State) -> Iterator[tuple[int, RecordHead, int, int]]:
        """The records of one tape, with their positions and CRCs."""
        position, end = state.tail, state.head
        if end - position > self.header.budget:
            self.damaged += 1
            return
        while position < end and self._left > 0:
            self._left -= 1
            data = read_tape(self._source, self.header, at, position, RECORD_SIZE)
            try:
                head, crc = parse_record(data, end - position)
            except ValueError:
                if (tail := self._tail(at)) > position:  # the recorder has given it up meanwhile
                    position = tail
                    continue
                self.damaged += 1
                return
            yield at, head, position, crc
            position += head.size

    def _tail(self, at: int) -> int:
        return self._state(at)[0].tail

    def _message(self, at: int, head: RecordHead, position: int, crc: int) -> Recorded | None:
        """Read a message; None if it is damaged, or given up while it was read."""
        start = position + RECORD_SIZE
        body = memoryview(read_tape(self._source, self.header, at, start, head.body_size))
        schema, rest = body[: head.schema_size], body[head.schema_size :]
        meta, data = rest[: head.meta_size], rest[head.meta_size :]
        if crc_of(RECORD.pack(*head), (schema, meta, data)) != crc:
            return None
        if len(body) > SMALL and self._tail(at) > position:
            return None
        return Recorded(at, head, bytes(schema) or self._schema(at), bytes(meta), bytes(data))

    def _schema(self, at: int) -> bytes:
        """The schema of the state, which the recorder may have written after the first look."""
        return self._states[at][1] or self._state(at)[1]

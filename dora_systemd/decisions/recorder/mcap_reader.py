"""Reads the last message of a topic from an MCAP file that mcap.py has written, and nothing else.

A recording has up to hundreds of megabytes, and the status page needs one message of each camera:
the index leads to that. Anybody may have written the file, so no number in it is believed.
"""

import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

from dora_systemd.decisions.recorder.mcap import (
    CHANNEL,
    CHUNK_INDEX,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    MOST_CHANNELS,
    RECORD,
    SCHEMA,
    SPAN,
)

Read = Callable[[int, int], bytes]
"""Reads bytes of the file from a place on; less comes at its end."""

MOST_SUMMARY = 8 * 1024 * 1024
_MOST_RECORDS = 100_000
_FOOTER = struct.Struct("<QQI")
_INDEX_HEAD = struct.Struct("<HI")
_END = RECORD.size + _FOOTER.size + len(MAGIC)
_CHUNK_HEAD = RECORD.size + SPAN.size + struct.calcsize("<QIIQ")
"""Bytes of a chunk before its records: it has no compression."""


class Message(NamedTuple):
    """A message of the file."""

    schema: bytes
    sequence: int
    log_ns: int
    data: bytes


class _Channel(NamedTuple):
    number: int
    schema: int  # 0 for none
    topic: str
    encoding: str


class McapReader:
    """An open file. size: its bytes. most: of a message. Raises ValueError for another file."""

    def __init__(self, read: Read, size: int, most: int) -> None:
        self._read_at, self._size, self._most = read, size, most
        self._schemas: dict[int, bytes] = {}
        self._channels: list[_Channel] = []
        self._chunks: list[tuple[int, dict[int, int]]] = []
        try:
            self._read_summary()
        except struct.error as error:
            raise ValueError("its summary is damaged") from error

    def _read(self, at: int, size: int) -> bytes:
        if not 0 <= at <= self._size - size:
            raise ValueError("a place is behind the end of the file")
        return self._read_at(at, size)

    def _read_summary(self) -> None:
        end = self._read(self._size - _END, _END)
        opcode, length = RECORD.unpack_from(end)
        start, _, _ = _FOOTER.unpack_from(end, RECORD.size)
        size = self._size - _END - start
        is_whole = end.endswith(MAGIC) and (opcode, length) == (FOOTER, _FOOTER.size)
        if not is_whole or not 0 <= size <= MOST_SUMMARY:
            raise ValueError("it has no end, or too large a summary")
        for opcode, data in _records(self._read(start, size)):
            if opcode == SCHEMA:
                (number,), _, _ = data.numbers("<H"), data.some(), data.some()
                self._schemas[number] = data.some()
            elif opcode == CHANNEL and len(self._channels) < MOST_CHANNELS:
                number, own = data.numbers("<HH")
                self._channels.append(_Channel(number, own, data.text(), data.text()))
            elif opcode == CHUNK_INDEX:
                _, _, place, _ = data.numbers("<QQQQ")
                indexes = dict(struct.iter_unpack("<HQ", data.some()))
                self._chunks.append((place, indexes))

    def topics(self, encoding: str) -> list[str]:
        """The topics whose messages have this encoding."""
        return list(dict.fromkeys(one.topic for one in self._channels if one.encoding == encoding))

    def last(self, topic: str) -> Message | None:
        """The last message of a topic, None if there is none. Raises ValueError."""
        try:
            own = (self._last_of(one) for one in self._channels if one.topic == topic)
            return max(filter(None, own), key=lambda one: one.sequence, default=None)
        except struct.error as error:
            raise ValueError("a record is damaged") from error

    def _last_of(self, channel: _Channel) -> Message | None:
        number = channel.number
        chunks = ((at, one[number]) for at, one in reversed(self._chunks) if number in one)
        for chunk, index in chunks:
            head = self._read(index, RECORD.size + _INDEX_HEAD.size)
            opcode, _ = RECORD.unpack_from(head)
            own, size = _INDEX_HEAD.unpack_from(head, RECORD.size)
            if (opcode, own) != (MESSAGE_INDEX, number) or size < SPAN.size:
                raise ValueError("an index is damaged")
            entry = self._read(index + len(head) + size - SPAN.size, SPAN.size)
            return self._message(channel, chunk + _CHUNK_HEAD + SPAN.unpack(entry)[1])
        return None

    def _message(self, channel: _Channel, place: int) -> Message:
        before = RECORD.size + MESSAGE_HEAD.size
        head = self._read(place, before)
        opcode, length = RECORD.unpack_from(head)
        number, sequence, log_ns, _ = MESSAGE_HEAD.unpack_from(head, RECORD.size)
        size = length - MESSAGE_HEAD.size
        if (opcode, number) != (MESSAGE, channel.number) or not 0 <= size <= self._most:
            raise ValueError("a message is damaged, or too large")
        data = self._read(place + before, size)
        return Message(self._schemas.get(channel.schema, b""), sequence, log_ns, data)


class _Fields:
    """Takes fields off the front of a record."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def numbers(self, form: str) -> tuple[int, ...]:
        found = struct.unpack_from(form, self._data, self._at)
        self._at += struct.calcsize(form)
        return found

    def some(self) -> bytes:
        (size,) = self.numbers("<I")
        data = self._data[self._at : self._at + size]
        self._at += size
        return data

    def text(self) -> str:
        return self.some().decode(errors="replace")


def _records(data: bytes) -> Iterator[tuple[int, _Fields]]:
    """The records of a summary."""
    at = 0
    for _ in range(_MOST_RECORDS):
        if at >= len(data):
            return
        opcode, size = RECORD.unpack_from(data, at)
        at += RECORD.size
        yield opcode, _Fields(data[at : at + size])
        at += size

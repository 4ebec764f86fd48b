"""A strict reader of MCAP, from its specification: what `mcap doctor` would refuse fails."""

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX) = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0B, 0x10)


class Read(NamedTuple):
    """One message."""

    topic: str
    encoding: str
    schema: bytes
    sequence: int
    log: int
    publish: int
    data: bytes


class Fields:
    """Takes fields off the front of a record."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def take(self, form: str) -> Any:
        size = struct.calcsize("<" + form)
        numbers, self.data = struct.unpack("<" + form, self.data[:size]), self.data[size:]
        return numbers[0] if len(numbers) == 1 else numbers

    def some(self, length: str = "I") -> bytes:
        size = self.take(length)
        assert size <= len(self.data)
        data, self.data = self.data[:size], self.data[size:]
        return data

    def text(self) -> str:
        return self.some().decode()

    def mapping(self, key: Callable[["Fields"], Any], value: Callable[["Fields"], Any]) -> Any:
        inner, found = Fields(self.some()), {}
        while inner.data:
            name = key(inner)
            assert name not in found
            found[name] = value(inner)
        return found


def records(data: bytes, base: int = 0) -> Iterator[tuple[int, int, int, Fields]]:
    """Opcode, place, length with the head, and content."""
    at = 0
    while at < len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        assert at + 9 + size <= len(data), "a record is cut"
        yield opcode, base + at, 9 + size, Fields(data[at + 9 : at + 9 + size])
        at += 9 + size


class File:
    """All of a file."""

    def __init__(self, data: bytes) -> None:
        assert data.startswith(MAGIC)
        assert data.endswith(MAGIC)
        self.data, self.messages = data, list[Read]()
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.channels: dict[int, tuple[int, str, str]] = {}
        self.counts: dict[int, int] = {}
        self.chunks: list[tuple[int, int]] = []
        self.places: dict[int, dict[int, list[tuple[int, int]]]] = {}
        self.seen: list[tuple[int, int, int]] = []
        self._read(data)

    def _read(self, data: bytes) -> None:
        body = data[len(MAGIC) : -len(MAGIC)]
        for opcode, at, size, fields in records(body, len(MAGIC)):
            self.seen.append((opcode, at, size))
            if opcode == CHUNK:
                self._chunk(at, size, fields)
            elif opcode == MESSAGE_INDEX:
                channel, entries = fields.take("H"), Fields(fields.some())
                mine = self.places[self.chunks[-1][0]][channel]
                while entries.data:
                    assert entries.take("QQ") in mine
                    mine.pop(0)
                assert not mine, "a message is in no index"
            elif opcode == METADATA:
                self.metadata.append((fields.text(), fields.mapping(Fields.text, Fields.text)))
            elif opcode == DATA_END:
                assert fields.take("I") == zlib.crc32(data[:at])
                self._summary(at + size)
                return
        raise AssertionError("there is no end of the data")

    def _chunk(self, at: int, size: int, fields: Fields) -> None:
        start, end, length, crc = fields.take("QQQI")
        assert fields.text() == ""
        inner = fields.some("Q")
        assert (length, crc) == (len(inner), zlib.crc32(inner))
        self.chunks.append((at, size))
        self.places[at] = {}
        times = []
        for opcode, place, _, one in records(inner):
            if opcode == SCHEMA:
                self._schema(one)
            elif opcode == CHANNEL:
                self._channel(one)
            else:
                assert opcode == MESSAGE
                times.append(self._message(at, place, one))
        assert (start, end) == ((min(times), max(times)) if times else (0, 0))

    def _schema(self, one: Fields) -> None:
        identity, name, encoding, data = one.take("H"), one.text(), one.text(), one.some()
        assert identity
        assert self.schemas.setdefault(identity, (name, encoding, data)) == (name, encoding, data)

    def _channel(self, one: Fields) -> None:
        (number, schema), topic, encoding = one.take("HH"), one.text(), one.text()
        assert one.mapping(Fields.text, Fields.text) == {}
        assert not schema or schema in self.schemas
        mine = schema, topic, encoding
        assert self.channels.setdefault(number, mine) == mine

    def _message(self, chunk: int, place: int, one: Fields) -> int:
        channel, sequence, log, publish = one.take("HIQQ")
        schema, topic, encoding = self.channels[channel]
        data = self.schemas[schema][2] if schema else b""
        self.messages.append(Read(topic, encoding, data, sequence, log, publish, one.data))
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.places[chunk].setdefault(channel, []).append((log, place))
        assert isinstance(log, int)
        return log

    def _summary(self, start: int) -> None:
        footer_at = len(self.data) - len(MAGIC) - 29
        summary, footer = self.data[start:footer_at], self.data[footer_at : -len(MAGIC)]
        assert struct.unpack("<BQQQI", footer)[:3] == (FOOTER, 20, start)
        offsets_at, crc = struct.unpack("<QI", footer[17:])
        assert crc == zlib.crc32(summary + footer[:25])
        groups: dict[int, tuple[int, int]] = {}
        metadata = [one[1:] for one in self.seen if one[0] == METADATA]
        chunks, named = list(self.chunks), [name for name, _ in self.metadata]
        for opcode, at, size, one in records(summary, start):
            if at >= offsets_at:
                assert opcode == SUMMARY_OFFSET
                group, place, length = one.take("BQQ")
                assert groups.pop(group) == (place, length)
                continue
            first, length = groups.get(opcode, (at, 0))
            groups[opcode] = first, length + size
            if opcode == SCHEMA:
                self._schema(one)
            elif opcode == CHANNEL:
                self._channel(one)
            elif opcode == METADATA_INDEX:
                assert one.take("QQ") == metadata.pop(0)
                assert one.text() == named.pop(0)
            elif opcode == CHUNK_INDEX:
                one.take("QQ")
                assert one.take("QQ") == chunks.pop(0)
                places = one.mapping(lambda two: two.take("H"), lambda two: two.take("Q"))
                assert all(self.data[place] == MESSAGE_INDEX for place in places.values())
            else:
                assert opcode == STATISTICS
                self._statistics(one)
        assert not chunks
        assert not metadata
        assert not groups, "a group has no offset"

    def _statistics(self, one: Fields) -> None:
        counts = one.take("QHIIIIQQ")
        times = [message.log for message in self.messages]
        assert counts == (
            *(len(self.messages), len(self.schemas), len(self.channels), 0, len(self.metadata)),
            *(len(self.chunks), min(times, default=0), max(times, default=0)),
        )
        by = one.mapping(lambda two: two.take("H"), lambda two: two.take("Q"))
        assert by == self.counts

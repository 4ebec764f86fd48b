"""Makes an MCAP file of a ring: a channel for each output, and metadata records with the facts.

See https://mcap.dev/spec: chunks with an index and CRCs, without compression. Messages of a camera
do not compress, and Python has zstd from 3.14 on only. Nothing that was written is read or changed
again, so the file can be a pipe.
"""

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from dora_systemd import __version__
from dora_systemd.decisions.recorder.reading import Reading, Recorded

Write = Callable[[bytes], object]

MAGIC = b"\x89MCAP0\r\n"
CHUNK_SIZE = 1024 * 1024
"""Bytes after which a chunk ends."""
MOST_CHANNELS = 4096
MAX_TIME = (1 << 63) - 1
_HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, _CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = range(0x0B, 0x10)
RECORD = struct.Struct("<BQ")
"""What a record begins with: its type, and the bytes that follow."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
SPAN = struct.Struct("<QQ")
_COUNTS = struct.Struct("<QHIIIIQQ")


def _text(text: str) -> bytes:
    data = text.encode(errors="replace")
    return struct.pack("<I", len(data)) + data


def _mapping(pairs: Iterable[tuple[bytes, bytes]]) -> bytes:
    data = b"".join(key + value for key, value in pairs)
    return struct.pack("<I", len(data)) + data


def _texts(texts: Mapping[str, str]) -> bytes:
    return _mapping((_text(key), _text(value)) for key, value in texts.items())


def _numbers(form: str, numbers: Mapping[int, int]) -> bytes:
    return _mapping((struct.pack("<H", key), struct.pack(form, n)) for key, n in numbers.items())


def _record(opcode: int, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return RECORD.pack(opcode, len(content)) + content


def _crc_of(parts: Iterable[bytes]) -> int:
    crc = 0
    for one in parts:
        crc = zlib.crc32(one, crc)
    return crc


def _time(time_ns: int) -> int:
    return min(max(time_ns, 0), MAX_TIME)


class Times(NamedTuple):
    """The times of the first and of the last message."""

    first: int = MAX_TIME
    last: int = 0

    def with_time(self, time_ns: int) -> "Times":
        """The times with one more message."""
        return Times(min(self.first, time_ns), max(self.last, time_ns))

    def pack(self) -> bytes:
        """Both in a record; 0 without messages."""
        return SPAN.pack(*(self if self.first <= self.last else (0, 0)))


class McapWriter:
    """Writes one file. library: the program, for the header."""

    def __init__(self, write: Write, library: str) -> None:
        self._write = write
        self._offset = self._crc = 0
        self._channels: dict[tuple[str, bytes], int] = {}
        self._schemas: list[bytes] = []
        self._definitions: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._times, self._chunk_times = Times(), Times()
        self._chunk: list[bytes] = []
        self._size = 0
        self._index: dict[int, list[bytes]] = {}
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._put(MAGIC)
        self._put(_record(_HEADER, _text(""), _text(library)))

    def _put(self, data: bytes) -> int:
        """Write into the file; return where that began."""
        before = self._offset
        self._write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)
        return before

    def add_metadata(self, name: str, texts: Mapping[str, str]) -> None:
        """Write texts about the whole file."""
        self._end_chunk()
        data = _record(_METADATA, _text(name), _texts(texts))
        place = SPAN.pack(self._put(data), len(data))
        self._metadata_indexes.append(_record(_METADATA_INDEX, place, _text(name)))

    def channel(self, topic: str, encoding: str, schema: bytes = b"") -> int | None:
        """The channel of a topic whose messages have this schema, or None if there are too many."""
        key = topic, schema
        if key not in self._channels:
            if len(self._channels) >= MOST_CHANNELS:
                return None
            self._channels[key] = len(self._channels)
            self._define(self._channels[key], topic, encoding, schema)
        return self._channels[key]

    def _define(self, number: int, topic: str, encoding: str, schema: bytes) -> None:
        identity = len(self._schemas) + 1 if schema else 0
        if schema:
            data = struct.pack("<I", len(schema)), schema
            head = struct.pack("<H", identity)
            self._schemas.append(_record(SCHEMA, head, _text(topic), _text(encoding), *data))
            self._add(self._schemas[-1])
        head = struct.pack("<HH", number, identity)
        record = _record(CHANNEL, head, _text(topic), _text(encoding), _texts({}))
        self._definitions.append(record)
        self._add(record)

    def message(self, channel: int, sequence: int, log: int, publish: int, data: bytes) -> None:
        """Write a message. log, publish: ns since 1970."""
        log, publish = _time(log), _time(publish)
        self._index.setdefault(channel, []).append(SPAN.pack(log, self._size))
        self._counts[channel] = self._counts.get(channel, 0) + 1
        self._times, self._chunk_times = (
            self._times.with_time(log),
            self._chunk_times.with_time(log),
        )
        head = MESSAGE_HEAD.pack(channel, sequence % (1 << 32), log, publish)
        self._add(RECORD.pack(MESSAGE, len(head) + len(data)) + head, data)
        if self._size >= CHUNK_SIZE:
            self._end_chunk()

    def _add(self, *parts: bytes) -> None:
        self._chunk += parts
        self._size += sum(map(len, parts))

    def _end_chunk(self) -> None:
        if not self._chunk:
            return
        size, span = self._size, self._chunk_times.pack()
        # A large message is not copied: it can have most of the bytes that a reader may use.
        records = self._chunk if size > 2 * CHUNK_SIZE else [b"".join(self._chunk)]
        sizes = struct.pack("<QI", size, _crc_of(records)), _text(""), struct.pack("<Q", size)
        head = span + b"".join(sizes)
        start = self._put(RECORD.pack(_CHUNK, len(head) + size) + head)
        for one in records:
            self._put(one)
        length, places = self._offset - start, dict[int, int]()
        for channel, entries in self._index.items():
            index = struct.pack("<HI", channel, sum(map(len, entries)))
            places[channel] = self._put(_record(MESSAGE_INDEX, index, *entries))
        index_length = self._offset - start - length
        place, indexes = SPAN.pack(start, length), _numbers("<Q", places)
        ends = struct.pack("<Q", index_length), _text(""), SPAN.pack(size, size)
        self._chunk_indexes.append(_record(CHUNK_INDEX, span, place, indexes, *ends))
        self._chunk, self._size, self._index, self._chunk_times = [], 0, {}, Times()

    def finish(self) -> None:
        """Write the summary and the end."""
        self._end_chunk()
        self._put(_record(_DATA_END, struct.pack("<I", self._crc)))
        start, self._crc = self._offset, 0
        counts = (
            *(sum(self._counts.values()), len(self._schemas), len(self._channels), 0),
            *(len(self._metadata_indexes), len(self._chunk_indexes)),
        )
        times = SPAN.unpack(self._times.pack())
        statistics = _record(
            _STATISTICS, _COUNTS.pack(*counts, *times), _numbers("<Q", self._counts)
        )
        groups = {
            SCHEMA: self._schemas,
            CHANNEL: self._definitions,
            _STATISTICS: [statistics],
            CHUNK_INDEX: self._chunk_indexes,
            _METADATA_INDEX: self._metadata_indexes,
        }
        offsets = [self._put_group(*group) for group in groups.items() if group[1]]
        offset = self._put(b"".join(offsets))
        footer = RECORD.pack(FOOTER, SPAN.size + 4) + SPAN.pack(start, offset)
        self._put(footer + struct.pack("<I", zlib.crc32(footer, self._crc)))
        self._put(MAGIC)

    def _put_group(self, opcode: int, records: list[bytes]) -> bytes:
        data = b"".join(records)
        start = self._put(data)
        return _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, len(data)))


ENCODING = "arrow"
"""Encoding of messages and schemas: encapsulated IPC messages of Arrow, a schema and its record
batches, which have one column, `value`."""
JSON = "json"
META = "#metadata"
"""What follows NODE/OUTPUT in the topic of dora's metadata, which are JSON."""
RUN, OUTPUT = "dora-systemd", "dora-systemd output"
"""Names of the metadata records: of the file, and of each output."""
FIELDS = ("received", "dropped", "evicted", "too_large", "largest")
"""Of State, in the metadata record of an output."""
_NOTHING = (b"", b"{}")


class Written(NamedTuple):
    """What a file has."""

    messages: int
    outputs: int  # with at least one message
    losses: int  # messages that were received, or dropped by dora, and are not in the file
    damaged: int
    is_cut: bool  # whether there was more than may be read


def write_recording(reading: Reading, write: Write, facts: Mapping[str, str]) -> Written:
    """Write all messages of a ring. facts: in addition to those in its header."""
    file, names = McapWriter(write, f"dora-systemd {__version__}"), reading.header.outputs
    recorded = [0] * len(names)
    for message in reading.messages():
        if _add(file, names[message.output], message):
            recorded[message.output] += 1
    losses = 0
    for name, state, count in zip(names, reading.states, recorded, strict=True):
        lost = max(state.dropped + state.evicted + state.too_large, 0)
        losses += lost
        numbers = {key: str(getattr(state, key)) for key in FIELDS}
        file.add_metadata(OUTPUT, {"output": name, "recorded": str(count), **numbers})
    whole = {"damaged": str(reading.damaged), "cut": "yes" if reading.is_cut else "no"}
    file.add_metadata(RUN, {**reading.header.facts, **facts, **whole})
    file.finish()
    outputs = sum(one > 0 for one in recorded)
    return Written(sum(recorded), outputs, losses, reading.damaged, reading.is_cut)


def _add(file: McapWriter, topic: str, message: Recorded) -> bool:
    """Whether the file has the message now."""
    channel, head = file.channel(topic, ENCODING, message.schema), message.head
    if channel is None or not message.schema:
        return False
    times = head.received_ns, head.sent_ns or head.received_ns
    file.message(channel, head.number, *times, message.data)
    if message.meta not in _NOTHING and (own := file.channel(topic + META, JSON)) is not None:
        file.message(own, head.number, *times, message.meta)
    return True

"""The format of the ring.

The recorder imports this and writer.py into the Python of the nodes, without the rest of the
package. So both import the standard library only, and are valid for Python 3.9.

header: magic, version, number of outputs, span, budget, length of the JSON text, CRC; the text.
state: one page for each output. Twice, written in turn: CRC, length of the schema, version, tail,
head and counters, of which the last version without damage counts; then the schema.
tape: `span` bytes for each output. A record: magic, CRC, length, number, times, lengths of its
parts; its own schema unless it is that of the state, metadata, and an Arrow IPC message. Of a part
above 64 kB the CRC has the beginning and the end: that of 1 MB takes 0.7 ms, and the window already
shows whether a message is whole.

All numbers are little-endian. Times are in ns.
"""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

ALIGN = 64 * 1024
"""The largest page of any machine. The parts of the file begin at multiples of it."""
MOST_OUTPUTS = 256
MOST_TEXT = ALIGN - 64
"""Maximum bytes of the JSON text."""
MAGIC, RECORD_MAGIC, VERSION = b"DORARING", 0x43455244, 2
HEADER = struct.Struct("<8sIIQQII")
CRC = struct.Struct("<I")
STATE = struct.Struct("<IQQQQQQQQ")
"""Without the CRC in front: the length of the schema, then the fields of State."""
STATE_SIZE = CRC.size + STATE.size
RECORD = struct.Struct("<QQqqqIII")
"""Without magic and CRC in front: the fields of RecordHead."""
SCHEMA_AT = 256
"""Where the schema begins in the page of a state."""
MOST_SCHEMA = ALIGN - SCHEMA_AT
_PREFIX = 2 * CRC.size
RECORD_SIZE = _PREFIX + RECORD.size
SMALL = 64 * 1024
"""Bytes: of a larger message only the last is kept, unless the output is named."""
_CHECKED = 4096
"""Bytes at both ends of a part above SMALL that its CRC has."""

Part = Any
"""What os.pwritev() takes: bytes, or a buffer."""


class Store(Protocol):
    """The file of a ring."""

    def write(self, at: int, parts: Sequence[Part]) -> None:
        """Write the parts one after the other."""

    def read(self, at: int, size: int) -> bytes:
        """Read; what is a hole is 0."""

    def punch(self, at: int, size: int) -> None:
        """Make a hole, which takes no memory. Both are multiples of the size of a page."""


class Header(NamedTuple):
    """What is known when the ring is created."""

    outputs: Sequence[str]  # NODE/OUTPUT of each tape
    span: int  # bytes of each tape, a multiple of ALIGN
    budget: int  # bytes that all tapes together may use
    last: int  # ns: how long a message is kept
    only_small: bool  # whether larger messages than SMALL replace each other
    facts: Mapping[str, str]  # for the file that is made of the ring


class State(NamedTuple):
    """The window of a tape, and counters of its output since the ring was created."""

    tail: int = 0  # the position of the oldest message
    head: int = 0  # the position after the last message
    received: int = 0
    dropped: int = 0  # messages that dora dropped before the recorder could receive them
    evicted: int = 0  # younger messages than `last` that had to go because of the budget
    too_large: int = 0  # messages for which the budget is too small
    largest: int = 0  # bytes of the largest of those
    version: int = 0  # of this state


class RecordHead(NamedTuple):
    """The numbers of one message."""

    size: int  # of the whole record, a multiple of 8
    number: int  # of the message in the ring, from 1
    received_ns: int  # CLOCK_REALTIME
    steady_ns: int  # CLOCK_BOOTTIME
    sent_ns: int  # dora's time of the message
    schema_size: int  # 0 if the schema is that of the state
    meta_size: int
    data_size: int

    @property
    def body_size(self) -> int:
        """Bytes of the parts."""
        return self.schema_size + self.meta_size + self.data_size


def span_of(budget: int) -> int:
    """Bytes of a tape, of which at most `budget` are in use."""
    return (budget // ALIGN + 2) * ALIGN


def size_of(header: Header) -> int:
    """Bytes of the file, nearly all of which are holes."""
    return ALIGN + len(header.outputs) * (ALIGN + header.span)


def state_at(at: int) -> int:
    """Where the state of the output number `at` begins."""
    return ALIGN * (1 + at)


def tape_at(header: Header, at: int) -> int:
    """Where the tape of the output number `at` begins."""
    return state_at(len(header.outputs)) + at * header.span


def format_header(header: Header) -> bytes:
    """The first bytes of the file. Raises ValueError for what has no room there."""
    text = json.dumps(
        {
            "outputs": list(header.outputs),
            "last": header.last,
            "only_small": header.only_small,
            "facts": dict(header.facts),
        }
    ).encode()
    if len(text) > MOST_TEXT or len(header.outputs) > MOST_OUTPUTS:
        raise ValueError("too many outputs, or too long names")
    numbers = MAGIC, VERSION, len(header.outputs), header.span, header.budget, len(text)
    return HEADER.pack(*numbers, zlib.crc32(HEADER.pack(*numbers, 0) + text)) + text


def parse_header(data: bytes) -> Header:
    """The inverse of format_header. Raises ValueError."""
    if len(data) < HEADER.size:
        raise ValueError("it is too short")
    magic, version, count, span, budget, size, crc = HEADER.unpack_from(data)
    text = data[HEADER.size : HEADER.size + size]
    if magic != MAGIC or version != VERSION:
        raise ValueError("it is no ring of this version")
    if size > MOST_TEXT or zlib.crc32(HEADER.pack(magic, *_numbers(data), 0) + text) != crc:
        raise ValueError("its header is damaged")
    if span != span_of(budget) or not 0 < count <= MOST_OUTPUTS:
        raise ValueError("its sizes are impossible")
    try:
        return _with_text(json.loads(text), count, span, budget)
    except RecursionError as error:
        raise ValueError("its text is nested too deeply") from error


def _numbers(data: bytes) -> Sequence[int]:
    return HEADER.unpack_from(data)[1:-1]


def _with_text(text: Any, count: int, span: int, budget: int) -> Header:
    if not isinstance(text, dict) or not isinstance(text.get("facts"), dict):
        raise ValueError("its text is no mapping")
    names, last = text.get("outputs"), text.get("last")
    if not isinstance(names, list) or len(names) != count or type(last) is not int:
        raise ValueError("its text lacks outputs")
    facts = {str(key): str(value) for key, value in text["facts"].items()}
    return Header(list(map(str, names)), span, budget, last, bool(text.get("only_small")), facts)


def format_state(state: State, schema: bytes) -> bytes:
    """The state of an output. Its CRC includes the schema, which is written once."""
    numbers = STATE.pack(len(schema), *state)
    return CRC.pack(zlib.crc32(schema, zlib.crc32(numbers))) + numbers


def read_state(store: Any, at: int) -> "tuple[State, bytes]":
    """The state of an output, and its schema; all 0 if it has none. Raises ValueError."""
    page = state_at(at)
    data = store.read(page, 2 * STATE_SIZE)
    if not any(data):
        return State(), b""
    schema = store.read(page + SCHEMA_AT, _size_of_schema(data))
    halves = data[:STATE_SIZE], data[STATE_SIZE:]
    found = [one for half in halves for one in _states_in(half, schema)]
    if not found:
        raise ValueError("its state is damaged")
    return max(found, key=lambda one: one[0].version)


def _size_of_schema(data: bytes) -> int:
    sizes = (CRC.unpack_from(data, at + CRC.size)[0] for at in (0, STATE_SIZE))
    return max(one if one <= MOST_SCHEMA else 0 for one in sizes)


def _states_in(data: bytes, schema: bytes) -> "Sequence[tuple[State, bytes]]":
    (crc,), (size, *numbers) = CRC.unpack_from(data), STATE.unpack_from(data, CRC.size)
    own = schema[:size]
    is_whole = size <= len(schema) and zlib.crc32(own, zlib.crc32(data[CRC.size :])) == crc
    return [(State(*numbers), own)] if is_whole else []


def format_record(head: RecordHead, parts: Sequence[Part]) -> bytes:
    """What precedes the parts of a record."""
    numbers = RECORD.pack(*head)
    return struct.pack("<II", RECORD_MAGIC, crc_of(numbers, parts)) + numbers


def crc_of(numbers: bytes, parts: Sequence[Part]) -> int:
    """The CRC of a record. numbers: its head without magic and CRC."""
    crc = zlib.crc32(numbers)
    for one in parts:
        if len(one) <= SMALL:
            crc = zlib.crc32(one, crc)
        else:
            data = memoryview(one)
            crc = zlib.crc32(data[-_CHECKED:], zlib.crc32(data[:_CHECKED], crc))
    return crc


def parse_record(data: bytes, most: int) -> "tuple[RecordHead, int]":
    """The numbers of a record of at most `most` bytes, and its CRC. Raises ValueError."""
    if len(data) < RECORD_SIZE:
        raise ValueError("it is too short")
    magic, crc = struct.unpack_from("<II", data)
    head = RecordHead(*RECORD.unpack_from(data, _PREFIX))
    is_whole = RECORD_SIZE + head.body_size <= head.size <= most and head.size % 8 == 0
    if magic != RECORD_MAGIC or not is_whole:
        raise ValueError("it is no record")
    return head, crc


def read_tape(store: Any, header: Header, at: int, position: int, size: int) -> bytes:
    """Bytes of a tape from a position on."""
    base, place = tape_at(header, at), position % header.span
    first = min(size, header.span - place)
    data: bytes = store.read(base + place, first)
    return data if first == size else data + store.read(base, size - first)

"""Makes files of pictures that nodes have sent, without pyarrow and without a viewer.

A picture is an array of uint8, and dora's metadata have its `encoding`: jpeg and png are files
already, rgb8 and bgr8 become PNG with their `width` and `height`. Whatever does not fit is no
picture: the nodes' user can write any bytes to the ring.
"""

import json
import struct
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple

from dora_systemd.decisions.recorder.reading import Recorded

MOST_EACH = 10
"""Pictures of each output: the last ones."""
_MOST = 256
"""Pictures of many outputs, but one of each in any case."""
MOST_PIXELS = 64 * 1024 * 1024
MOST_METADATA = 64 * 1024
_MOST_SEGMENTS = 1000
"""Of a JPEG, before its sizes."""
_SIZES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
"""The markers of a JPEG behind which its sizes are: SOF0 to SOF15."""
_FILES = {"jpeg": "jpg", "jpg": "jpg", "png": "png"}
_RAW = ("rgb8", "bgr8")
_STARTS = {"jpg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}
_CONTINUED, _INT, _SCHEMA, _BATCH = 0xFFFFFFFF, 2, 1, 3
_LEVEL = 1
"""Of zlib: a picture of a camera is hardly smaller with more."""


class Picture(NamedTuple):
    """A file."""

    output: int  # its place among the outputs of the recorder
    name: str  # such as 000123.jpg, by the number of the message
    data: bytes


def find_pictures(messages: Iterable[Recorded]) -> Iterator[Picture]:
    """The last pictures of each output."""
    last: dict[int, deque[Recorded]] = {}
    for one in messages:
        if is_picture(one.meta):
            last.setdefault(one.output, deque(maxlen=MOST_EACH)).append(one)
    most = max(_MOST // len(last), 1) if last else 0
    for output, found in last.items():
        for one in [*found][-most:]:
            if picture := picture_of(one):
                ending, data = picture
                yield Picture(output, f"{one.head.number:06}.{ending}", data)


def is_picture(metadata: bytes) -> bool:
    """Whether dora's metadata of a message are those of a picture."""
    return bool(_encoding(metadata))


def _metadata(text: bytes) -> dict[str, object]:
    if len(text) > MOST_METADATA:
        return {}
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _encoding(metadata: bytes) -> str:
    if b"encoding" not in metadata:
        return ""
    encoding = str(_metadata(metadata).get("encoding")).lower()
    return encoding if encoding in _FILES or encoding in _RAW else ""


def picture_of(message: Recorded) -> tuple[str, bytes] | None:
    """The ending of the file, and its bytes; None if the message is no picture."""
    encoding = _encoding(message.meta)
    try:
        data = array_bytes(message.schema, message.data)
    except (ValueError, struct.error):
        return None
    if ending := _FILES.get(encoding):
        return (ending, data) if data.startswith(_STARTS[ending]) else None
    metadata = _metadata(message.meta)
    width, height = metadata.get("width"), metadata.get("height")
    if type(width) is not int or type(height) is not int:
        return None
    if not 0 < width * height <= MOST_PIXELS or width < 1 or len(data) != 3 * width * height:
        return None
    if encoding == "bgr8":
        pixels = bytearray(data)
        pixels[0::3], pixels[2::3] = data[2::3], data[0::3]
        data = bytes(pixels)
    return "png", format_png(width, height, data)


def pixels_of(ending: str, data: bytes) -> int:
    """The pixels that a viewer makes of a file, by the sizes in it; 0 for no picture.

    A small file can have so many that a browser uses all memory.
    """
    with suppress(ValueError, struct.error):
        width, height = struct.unpack_from(">II", data, 16) if ending == "png" else _sizes(data)
        return int(width) * int(height)
    return 0


def _sizes(jpeg: bytes) -> tuple[int, int]:
    at = 2
    for _ in range(_MOST_SEGMENTS):
        mark, kind, size = struct.unpack_from(">BBH", jpeg, at)
        if mark != 0xFF or size < 2:
            break
        if kind in _SIZES:
            height, width = struct.unpack_from(">HH", jpeg, at + 5)
            return width, height
        at += 2 + size
    raise ValueError("it has no sizes")


def format_png(width: int, height: int, rgb: bytes) -> bytes:
    """A PNG file of 3 bytes for each pixel."""
    row = 3 * width
    rows = b"".join(b"\0" + rgb[at : at + row] for at in range(0, row * height, row))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", zlib.compress(rows, _LEVEL)), (b"IEND", b"")
    return _STARTS["png"] + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    crc = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)


def array_bytes(schema: bytes, message: bytes) -> bytes:
    """The values of an Arrow IPC record batch with one column of uint8.

    Raises ValueError or struct.error for anything else.
    """
    kind, table, _ = _open(schema)
    fields = table.vector(1) if kind == _SCHEMA else []
    if len(fields) != 1 or fields[0].number(2, "<B") != _INT:
        raise ValueError("it is no array of integers")
    integer = fields[0].table(3)
    if integer.number(0, "<i") != 8 or integer.number(1, "<B"):
        raise ValueError("it is no array of uint8")
    kind, batch, body = _open(message)
    if kind != _BATCH or batch.has(3):
        raise ValueError("it is no record batch without compression")
    length, (offset, size) = batch.number(0, "<q"), batch.pair(2, 1)
    if not (0 <= length <= size and offset >= 0 and offset + size <= len(body)):
        raise ValueError("its buffer is not in the message")
    return body[offset : offset + length]


def _open(message: bytes) -> tuple[int, "_Table", bytes]:
    """The type of an encapsulated message, its header and its body."""
    mark, size = struct.unpack_from("<Ii", message)
    if mark != _CONTINUED or not 0 <= size <= len(message) - 8:
        raise ValueError("it is no message of Arrow")
    data = message[8 : 8 + size]
    root = _Table(data, struct.unpack_from("<I", data)[0])
    return root.number(1, "<B"), root.table(2), message[8 + size :]


class _Table:
    """A table of flatbuffers, whose places are checked by struct: they are unsigned."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self._at = data, at
        self._fields = at - self._read("<i", at)
        if self._fields < 0:
            raise ValueError("a table has no fields")

    def _read(self, form: str, at: int) -> int:
        number: int = struct.unpack_from(form, self._data, at)[0]
        return number

    def _place(self, field: int) -> int:
        if 4 + 2 * field >= self._read("<H", self._fields):
            return 0
        offset = self._read("<H", self._fields + 4 + 2 * field)
        return self._at + offset if offset else 0

    def has(self, field: int) -> bool:
        """Whether the field is there."""
        return self._place(field) > 0

    def number(self, field: int, form: str) -> int:
        """A number, 0 if it is not there."""
        place = self._place(field)
        return self._read(form, place) if place else 0

    def _follow(self, field: int) -> int:
        if not (place := self._place(field)):
            raise ValueError("a field is missing")
        return place + self._read("<I", place)

    def table(self, field: int) -> "_Table":
        """Another table."""
        return _Table(self._data, self._follow(field))

    def vector(self, field: int) -> list["_Table"]:
        """The first tables of a vector."""
        start = self._follow(field)
        places = (start + 4 + 4 * at for at in range(min(self._read("<I", start), 2)))
        return [_Table(self._data, one + self._read("<I", one)) for one in places]

    def pair(self, field: int, index: int) -> tuple[int, int]:
        """A structure of two numbers in a vector."""
        start = self._follow(field)
        if index >= self._read("<I", start):
            raise ValueError("a vector is too short")
        first, second = struct.unpack_from("<qq", self._data, start + 4 + 16 * index)
        return first, second

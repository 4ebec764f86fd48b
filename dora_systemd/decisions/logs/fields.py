"""Encodes journal entries in the native protocol, and decodes the export format.

journalctl -o export prints the same form. https://systemd.io/JOURNAL_NATIVE_PROTOCOL/ and
systemd.journal-fields(7)
"""

import re
from collections.abc import Mapping

MAX_NAME = 64
_ILLEGAL = re.compile(r"[^A-Z0-9_]+")

Value = str | bytes | int


def legal_name(name: str, prefix: str) -> str:
    """The journal field name for `name`: upper case, [A-Z0-9_], at most 64 characters.

    prefix: such as DORA_. journald drops fields whose name begins with an underscore, which are its
    own, or with a digit.
    """
    return (prefix + _ILLEGAL.sub("_", name.upper()))[:MAX_NAME]


def encode_entry(fields: Mapping[str, Value]) -> bytes:
    """A complete entry, for one datagram to /run/systemd/journal/socket."""
    return b"".join(_encode_field(name, value) for name, value in fields.items())


def _encode_field(name: str, value: Value) -> bytes:
    """Encode one field, for a value with a newline with a 64-bit little-endian length."""
    data = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogateescape")
    key = name.encode("ascii")
    if b"\n" in data:
        return key + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"
    return key + b"=" + data + b"\n"


class ExportReader:
    """Decodes entries in the Journal Export Format from chunks of bytes.

    https://systemd.io/JOURNAL_EXPORT_FORMATS/#journal-export-format
    """

    def __init__(self) -> None:
        self._data = b""
        self._entry: dict[str, bytes] = {}

    def feed(self, data: bytes) -> list[dict[str, bytes]]:
        """The entries that `data` completes; the last value of a repeated field counts."""
        self._data += data
        entries = []
        position = 0
        while (end := self._data.find(b"\n", position)) >= 0:
            if end == position:
                if self._entry:
                    entries.append(self._entry)
                self._entry = {}
                position = end + 1
                continue
            after = self._field(position, end)
            if after is None:
                break
            position = after
        self._data = self._data[position:]
        return entries

    def _field(self, start: int, end: int) -> int | None:
        """Decode the field at `start`; the start of the next one, None if it is incomplete."""
        name, equals, value = self._data[start:end].partition(b"=")
        after = end + 1
        if not equals:
            first = end + 9
            # Of less than eight bytes, too: then the data ends before `first`.
            last = first + int.from_bytes(self._data[end + 1 : first], "little")
            if len(self._data) < last + 1:
                return None
            value, after = self._data[first:last], last + 1
        self._entry[name.decode("ascii", "replace")] = value
        return after

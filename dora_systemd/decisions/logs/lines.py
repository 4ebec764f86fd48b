"""Turns a node's bytes into lines, and lines into journal fields. Pure: no file, no clock.

The fields of a plain line are the same for all lines of a node. LineEncoder encodes them once, so
each line costs one concatenation: this handles tens of thousands of lines per second.

Entries are encoded in journald's native protocol; journalctl -o export prints the same form. See
https://systemd.io/JOURNAL_NATIVE_PROTOCOL/ and systemd.journal-fields(7).
"""

import json
import re
from collections.abc import Mapping
from typing import NamedTuple

from dora_systemd.values import as_mapping

MAX_NAME = 64
_ILLEGAL = r"[^A-Z0-9_]+"

Value = str | bytes | int


def legal_name(name: str, prefix: str) -> str:
    """The journal field name for `name`: upper case, [A-Z0-9_], at most 64 characters.

    prefix: such as DORA_. journald drops fields whose name begins with an underscore, which are its
    own, or with a digit.
    """
    return (prefix + re.sub(_ILLEGAL, "_", name.upper()))[:MAX_NAME]


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


LINE_LIMIT = 1 << 20
# dora's mark at the end of a line that it has cut at 1 MiB.
TRUNCATED = "... [truncated]"
MAX_FIELDS = 200  # journald refuses entries of more than 1024 fields, its own included

ERR, WARNING, NOTICE, INFO, DEBUG = 3, 4, 5, 6, 7
PRIORITIES = {"error": ERR, "warn": WARNING, "info": INFO, "debug": DEBUG, "trace": DEBUG}
PLAIN_PRIORITY = {"stdout": INFO, "stderr": NOTICE}

_ENDS = rb"[\r\n]"
_RETURNS = r"\r+"
_TOO_DEEP = "[nested too deeply]"
_ANSI = r"\x1b\[[0-9;]*m"
_TRACING = r"^(?P<timestamp>\d{4}-\d\d-\d\dT\S+Z)\s+(?P<level>ERROR|WARN)\s+(?P<message>.*)$"
_TARGET = r"(?:^|: )(?P<target>dora_[a-z0-9_]+(?:::[a-z0-9_]+)*): "


class Piece(bytes):
    """A part of a line without a newline: the line continues, or its writer ended there."""


class LineSplitter:
    """Splits bytes into lines. A line above `limit` bytes yields several `Piece`s and the rest.

    A carriage return ends a line, too, so each step of a progress bar is one; an empty line needs a
    newline. All other bytes pass unchanged, even NUL. rest: the bytes after the last line.
    """

    def __init__(self, limit: int = LINE_LIMIT) -> None:
        self.limit = limit
        self.rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes."""
        # A long line arrives in many chunks: do not search the whole buffer after each chunk.
        is_short = len(self.rest) + len(data) <= self.limit
        if is_short and not re.search(_ENDS, data) and self.rest[-1:] != b"\r":
            self.rest += data
            return []
        data = self.rest + data
        # The last carriage return may be half of "\r\n".
        whole = data.removesuffix(b"\r")
        lines = whole.split(b"\n")
        if b"\r" in whole:
            *ended, last = lines
            lines = [step for line in ended for step in _steps(line.removesuffix(b"\r"))]
            lines += _steps(last)
        self.rest = lines.pop()
        if len(data) > self.limit:
            lines = [piece for line in lines for piece in self._cut(line)]
            *pieces, self.rest = self._cut(self.rest)
            lines += pieces
        self.rest += data[len(whole) :]
        return lines

    def _cut(self, line: bytes) -> list[bytes]:
        cuts = range(0, max(len(line), 1), self.limit)
        pieces: list[bytes] = [Piece(line[cut : cut + self.limit]) for cut in cuts]
        pieces[-1] = bytes(pieces[-1])
        return pieces

    def flush(self) -> list[bytes]:
        """The bytes after the last newline, as a `Piece`: call this after the writer has ended."""
        rest, self.rest = self.rest.removesuffix(b"\r"), b""
        return [Piece(rest)] if rest else []


def _steps(line: bytes) -> list[bytes]:
    """The parts of a line between carriage returns: the last one, and those that are not empty."""
    *begun, last = line.split(b"\r")
    return [*filter(None, begun), last]


class Origin(NamedTuple):
    """The source of lines; `pid` 0 and `run` "" mean not known yet."""

    name: str
    uuid: str
    node: str = ""
    run: str = ""
    pid: int = 0

    def fields(self) -> dict[str, Value]:
        """The fields that every record of this origin has."""
        fields: dict[str, Value] = {
            # For `journalctl -t`.
            "SYSLOG_IDENTIFIER": f"{self.name}/{self.node}" if self.node else self.name,
            "DORA_DATAFLOW": self.uuid,
            "DORA_DATAFLOW_NAME": self.name,
            "DORA_NODE": self.node,
            "DORA_NODE_PID": self.pid or "",
            "DORA_RUN": self.run,
        }
        return {name: value for name, value in fields.items() if value != ""}


class LineEncoder:
    """Encodes the lines of one stream of one node as journal entries."""

    def __init__(self, origin: Origin, stream: str) -> None:
        self._constant = encode_entry({**origin.fields(), "DORA_STREAM": stream})
        priority = encode_entry({"PRIORITY": PLAIN_PRIORITY.get(stream, INFO)})
        self._plain = self._constant + priority + b"MESSAGE="
        self._piece = self._constant + priority + b"DORA_CUT=1\nMESSAGE="

    def entry(self, line: bytes) -> bytes:
        """The journal entry of one line (without its newline)."""
        if line[:1] == b"{" and (fields := json_fields(line)):
            cut = b"DORA_CUT=1\n" if type(line) is Piece else b""
            return self._constant + cut + encode_entry(fields)
        return (self._piece if type(line) is Piece else self._plain) + line + b"\n"


def json_fields(line: bytes) -> dict[str, Value] | None:
    """The fields of a line in dora's JSON log form (`node.log()`, Rust's tracing), else None."""
    if b'"level"' not in line or b'"timestamp"' not in line:
        return None
    try:
        record = json.loads(line)
        return _record_fields(record) if isinstance(record, dict) else None
    except (ValueError, RecursionError):  # also of json.dumps(), for almost too deep a nesting
        return None


def _record_fields(record: dict[str, object]) -> dict[str, Value] | None:
    level = str(record.get("level")).lower()
    if level not in PRIORITIES:
        return None
    own = dict(as_mapping(record.get("fields")))
    message = record.get("message")
    if message is None:
        message = own.pop("message", "")
    fields: dict[str, Value] = {
        "PRIORITY": PRIORITIES[level],
        "DORA_LEVEL": level,
        "DORA_TIMESTAMP": _text(record.get("timestamp")),
        "DORA_TARGET": _text(record.get("target")),
        "CODE_FILE": _text(record.get("file", record.get("filename"))),
        "CODE_LINE": _text(record.get("line", record.get("line_number"))),
    }
    fields = {name: value for name, value in fields.items() if value != ""}
    return {**fields, **_structured(own), "MESSAGE": _text(message)}


def jsonl_fields(line: bytes) -> dict[str, Value]:
    """The fields of a line of dora's own log file, log_<node>.jsonl."""
    try:
        record = json.loads(line)
        stream, level = _text(str(record["stream"] or "stdout")), str(record["level"])
        text = re.sub(_RETURNS, "\n", _text(record["msg"]).strip("\r"))
        own = _record_fields({**record, "timestamp": record.get("ts"), "message": text})
    except (ValueError, RecursionError, TypeError, KeyError):
        return {"PRIORITY": INFO, "MESSAGE": line}
    fields = own or {
        "PRIORITY": PLAIN_PRIORITY.get(level if level == "stderr" else stream, INFO),
        "DORA_TIMESTAMP": _text(record.get("ts")),
        "MESSAGE": text,
    }
    fields["DORA_STREAM"] = stream
    if text.endswith(TRUNCATED):
        fields["DORA_CUT"] = 1
    return fields


def _structured(own: dict[str, object]) -> dict[str, Value]:
    fields: dict[str, Value] = {}
    for key in list(own)[:MAX_FIELDS]:
        fields[legal_name(key, "DORA_FIELD_")] = _text(own.pop(key))
    if own:
        fields["DORA_FIELDS_MORE"] = _text(own)
    return fields


def _text(value: object) -> str:
    if value is None:
        return ""
    try:
        text = value if isinstance(value, str) else json.dumps(value)
    except RecursionError:
        return _TOO_DEEP  # json reads a level more than it writes
    # JSON may contain half of a surrogate pair, which UTF-8 cannot encode: escape it.
    return text.encode("utf-8", "backslashreplace").decode()


def dora_log_fields(line: bytes) -> dict[str, Value] | None:
    """The fields of a WARN or ERROR line of coordinator or daemon; None for their other lines.

    Their INFO lines contain the descriptor with its `env:` values, which must not be stored.
    """
    match = re.match(_TRACING, re.sub(_ANSI, "", line.decode("utf-8", "replace")))
    if match is None:
        return None
    target = re.search(_TARGET, match["message"])
    return _record_fields({**match.groupdict(), **(target.groupdict() if target else {})})

"""Bytes of a node -> lines -> fields."""

import json
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.logs.lines import (
    ExportReader,
    LineEncoder,
    LineSplitter,
    Origin,
    Piece,
    dora_log_fields,
    encode_entry,
    json_fields,
    jsonl_fields,
    legal_name,
)

LOG = b'{"level":"info","timestamp":"t","message":"m"'
ORIGIN = Origin("robot", "550e8400-e29b-41d4-a716-446655440000", "camera", "run1", 42)


def split(chunks: list[bytes], limit: int) -> list[bytes]:
    splitter = LineSplitter(limit)
    return [line for chunk in chunks for line in splitter.feed(chunk)] + splitter.flush()


@given(
    st.lists(st.binary(max_size=40) | st.sampled_from([b"\n", b"a" * 30, b"\x00\n"])),
    st.integers(1, 30),
)
def test_splitter_loses_nothing(chunks: list[bytes], limit: int) -> None:
    lines = split(chunks, limit)
    ended = (line if type(line) is Piece else line + b"\n" for line in lines)
    if not any(b"\r" in chunk for chunk in chunks):
        assert b"".join(ended) == b"".join(chunks)
    assert b"".join(lines) == re.sub(b"[\r\n]", b"", b"".join(chunks))
    assert all(len(line) <= limit for line in lines)


BYTES = st.lists(st.sampled_from([b"\r", b"\n", b"\r\n", b"a", b"bb"])).map(b"".join)


@given(st.binary(max_size=300) | BYTES, st.integers(1, 20), st.integers(1, 300))
def test_splitter_does_not_depend_on_chunks(data: bytes, size: int, limit: int) -> None:
    chunks = [data[start : start + size] for start in range(0, len(data), size)]
    assert split(chunks, limit) == split([data], limit)


@pytest.mark.parametrize(
    ("data", "lines"),
    [
        (b"", []),
        (b"\n", [b""]),
        (b"a\r\nb\n", [b"a", b"b"]),
        (b"a\r\r\n", [b"a", b""]),
        (b"a\rb\n", [b"a", b"b"]),
        (b"\r1%\r2%\r", [b"1%", Piece(b"2%")]),
        (b"\r\n\r\n", [b"", b""]),
        (b"\r\r", []),
        (b"\r\rabcde\rf", [Piece(b"abcd"), b"e", Piece(b"f")]),
        (b"\x00\xff\n\n", [b"\x00\xff", b""]),
        (b"abcdefgh\n", [Piece(b"abcd"), b"efgh"]),
        (b"abcdefghi\n", [Piece(b"abcd"), Piece(b"efgh"), b"i"]),
        (b"end", [Piece(b"end")]),
    ],
)
def test_splitter(data: bytes, lines: list[bytes]) -> None:
    found = split([data], 4)
    assert found == lines
    assert [type(line) for line in found] == [type(line) for line in lines]


def test_carriage_return_and_newline_in_two_chunks() -> None:
    assert split([b"a\r", b"\nb\r\n"], 100) == [b"a", b"b"]


def test_each_step_of_a_progress_bar_is_seen_when_the_next_one_begins() -> None:
    splitter = LineSplitter()
    shown = [splitter.feed(b"\r%d%%" % step) for step in range(4)]
    assert shown == [[], [b"0%"], [b"1%"], [b"2%"]]
    assert splitter.rest == b"3%"


class Counted(bytes):
    """Bytes that count how many of them are looked through for the end of a line."""

    searched = 0

    def __add__(self, other: Any) -> "Counted":
        return Counted(bytes(self) + other)

    def __radd__(self, other: bytes) -> "Counted":
        return Counted(other + bytes(self))

    def __contains__(self, wanted: object) -> bool:
        Counted.searched += len(self)
        return super().__contains__(wanted)  # type: ignore[operator]

    def removesuffix(self, suffix: Any) -> "Counted":
        return Counted(super().removesuffix(suffix))

    def split(self, *sep: Any) -> list[bytes]:
        Counted.searched += len(self)
        return super().split(*sep)


def test_a_long_line_is_not_looked_through_again_for_each_of_its_chunks() -> None:
    chunk, number = b"x" * 8192, 1024
    Counted.searched = 0
    splitter = LineSplitter()
    pieces = [line for _ in range(number) for line in splitter.feed(Counted(chunk))]
    assert {type(piece) for piece in pieces} == {Piece}
    assert b"".join([*pieces, splitter.rest]) == chunk * number
    assert 0 < Counted.searched <= 3 * len(chunk) * number


def test_plain_line() -> None:
    entry = LineEncoder(ORIGIN, "stdout").entry(b"h\x00i")
    assert set(entry.split(b"\n")) == {
        b"SYSLOG_IDENTIFIER=robot/camera",
        b"DORA_DATAFLOW=550e8400-e29b-41d4-a716-446655440000",
        b"DORA_DATAFLOW_NAME=robot",
        b"DORA_NODE=camera",
        b"DORA_NODE_PID=42",
        b"DORA_RUN=run1",
        b"DORA_STREAM=stdout",
        b"PRIORITY=6",
        b"MESSAGE=h\x00i",
        b"",
    }


def test_what_is_not_known_is_left_out() -> None:
    entry = LineEncoder(Origin("robot", "u", "camera"), "stderr").entry(b"x")
    assert b"DORA_NODE_PID" not in entry
    assert b"DORA_RUN" not in entry
    assert b"\nPRIORITY=5\n" in entry


def test_piece_is_marked() -> None:
    encoder = LineEncoder(ORIGIN, "stdout")
    assert b"\nDORA_CUT=1\n" in encoder.entry(Piece(b"x"))
    assert b"DORA_CUT" not in encoder.entry(b"x")
    whole = json.dumps({"level": "info", "timestamp": "t", "message": "m"}).encode()
    assert b"\nDORA_CUT=1\n" in encoder.entry(Piece(whole))


def test_line_of_node_log() -> None:
    line = (
        rb'{"timestamp":"2026-11-21T00:43:18.648985609+00:00","level":"warn","node_id":"spoof",'
        rb'"message":"hello \u00e4\nsecond","target":"my.t","file":"a.py","line":7,'
        rb'"fields":{"a":"1","b c":{"x":[2]}}}'
    )
    assert json_fields(line) == {
        "PRIORITY": 4,
        "DORA_LEVEL": "warn",
        "DORA_TIMESTAMP": "2026-11-21T00:43:18.648985609+00:00",
        "DORA_TARGET": "my.t",
        "CODE_FILE": "a.py",
        "CODE_LINE": "7",
        "DORA_FIELD_A": "1",
        "DORA_FIELD_B_C": '{"x": [2]}',
        "MESSAGE": "hello ä\nsecond",
    }


def test_line_of_rust_tracing() -> None:
    record = {
        "timestamp": "t",
        "level": "ERROR",
        "fields": {"message": "m", "n": 1},
        "filename": "main.rs",
        "line_number": 3,
    }
    fields = json_fields(json.dumps(record).encode())
    assert fields is not None
    assert fields["PRIORITY"] == 3
    assert fields["MESSAGE"] == "m"
    assert fields["DORA_FIELD_N"] == "1"
    assert "DORA_FIELD_MESSAGE" not in fields
    assert (fields["CODE_FILE"], fields["CODE_LINE"]) == ("main.rs", "3")


@pytest.mark.parametrize(
    "line",
    [
        b"{}",
        b"{",
        b'{"level":"info"}',
        b'{"level":"loud","timestamp":"t","message":"x"}',
        b'{"level":["info"],"timestamp":"t"}',
        b'{"level":"info","timestamp":"t"',
        b'{"level":"info","timestamp":"t","a":' + b"[" * 100_000,
        b'{"level":"info","timestamp":' + b"9" * 5000 + b"}",
    ],
)
def test_not_in_dora_form_is_plain(line: bytes) -> None:
    assert json_fields(line) is None
    entry = LineEncoder(ORIGIN, "stderr").entry(line)
    assert entry.endswith(b"\nDORA_STREAM=stderr\nPRIORITY=5\nMESSAGE=" + line + b"\n")


def test_half_a_surrogate_pair_is_no_error() -> None:
    line = b'{"level":"info","timestamp":"t","message":"\\ud800"}'
    assert b"MESSAGE=\\ud800\n" in LineEncoder(ORIGIN, "stdout").entry(line)


def test_no_depth_is_an_error() -> None:
    # Between what json reads and what it writes there is a level; which one depends on the stack.
    for depth in range(1100):
        value = b'"k":' + b"[" * depth + b"]" * depth
        assert json_fields(LOG + b',"fields":{' + value + b"}}") != {}
        assert jsonl_fields(b'{"stream":"stdout","level":"info","msg":"","fields":{%b}}' % value)


def test_half_a_surrogate_pair_in_the_name_of_a_stream_is_no_error() -> None:
    fields = jsonl_fields(b'{"ts":"t","level":"INFO","stream":"\\ud800","msg":"m"}')
    assert fields["DORA_STREAM"] == "\\ud800"


def test_many_fields_stay_below_the_limit_of_journald() -> None:
    record = {
        "level": "info",
        "timestamp": "t",
        "message": "m",
        "fields": {f"k{i}": i for i in range(2000)},
    }
    fields = json_fields(json.dumps(record).encode())
    assert fields is not None
    assert len(fields) < 300
    assert json.loads(str(fields["DORA_FIELDS_MORE"]))["k1999"] == 1999


@given(st.binary(max_size=200))
def test_no_line_is_an_error(line: bytes) -> None:
    for data in (line, b'{"level":"info","timestamp":"t",' + line):
        assert LineEncoder(ORIGIN, "stdout").entry(data).endswith(b"\n")


@pytest.mark.parametrize(
    ("line", "target"),
    [
        (b"2026-11-20T22:11:40.638554Z  WARN dora_coordinator: slow", "dora_coordinator"),
        (
            b"\x1b[2m2026-11-20T22:11:40.6Z\x1b[0m \x1b[33m WARN\x1b[0m \x1b[1mrun\x1b[0m: "
            b"\x1b[2mdora_daemon::log\x1b[0m\x1b[2m:\x1b[0m slow",
            "dora_daemon::log",
        ),
    ],
)
def test_warning_of_coordinator_or_daemon(line: bytes, target: str) -> None:
    fields = dora_log_fields(line)
    assert fields is not None
    assert fields["PRIORITY"] == 4
    assert fields["DORA_TARGET"] == target
    assert str(fields["MESSAGE"]).endswith("slow")


@pytest.mark.parametrize(
    "line",
    [
        b"2026-11-20T22:11:40.638554Z  INFO dora_coordinator: env: SECRET: hunter2",
        b"2026-11-20T22:11:40.638554Z DEBUG dora_coordinator: x",
        b"Listening on port 33453",
        b"  WARN SECRET=1",
        b"\xff\xfe",
        b"",
    ],
)
def test_all_else_that_they_print_is_dropped(line: bytes) -> None:
    assert dora_log_fields(line) is None


@pytest.mark.parametrize("key", ["message", "msg", "fields"])
def test_no_depth_of_nesting_is_an_error(key: str) -> None:
    """Some depths can be read and not be written again."""
    encoder = LineEncoder(ORIGIN, "stdout")
    for depth in range(900, 1001):
        deep = b"[" * depth + b"]" * depth
        value = b'{"x":%s}' % deep if key == "fields" else deep
        start = b'{"level":"info","timestamp":"t","ts":"t","stream":"stdout","msg":"m",'
        line = start.replace(b'"msg":"m",', b"") if key == "msg" else start
        line += b'"%s":%s}' % (key.encode(), value)
        assert encoder.entry(line)
        assert jsonl_fields(line)["MESSAGE"]


def test_fields_of_a_raw_line() -> None:
    line = (
        b'{"ts":"T","level":"stdout","node":"b","stream":"stderr","msg":"err",'
        b'"target":null,"fields":null}'
    )
    assert jsonl_fields(line) == {
        "PRIORITY": 5,
        "DORA_TIMESTAMP": "T",
        "DORA_STREAM": "stderr",
        "MESSAGE": "err",
    }


def test_fields_of_a_structured_line() -> None:
    line = (
        b'{"ts":"T","level":"warn","node":"b","stream":"stdout","msg":"m",'
        b'"target":"my.t","fields":{"a":"1"}}'
    )
    assert jsonl_fields(line) == {
        "PRIORITY": 4,
        "DORA_LEVEL": "warn",
        "DORA_TIMESTAMP": "T",
        "DORA_TARGET": "my.t",
        "DORA_FIELD_A": "1",
        "DORA_STREAM": "stdout",
        "MESSAGE": "m",
    }


def test_line_that_dora_cut() -> None:
    line = b'{"ts":"T","level":"stdout","stream":"stdout","msg":"xx... [truncated]"}'
    assert jsonl_fields(line)["DORA_CUT"] == 1


@pytest.mark.parametrize("line", [b"", b"{", b"[]", b"{}", b'{"stream":1,"level":2}', b"\xff"])
def test_broken_line_is_kept_as_it_is(line: bytes) -> None:
    assert jsonl_fields(line) == {"PRIORITY": 6, "MESSAGE": line}


NAMES = st.from_regex(r"[A-Z][A-Z0-9_]{0,63}", fullmatch=True)
VALUES = st.binary(max_size=100) | st.sampled_from([b"", b"\n", b"a\nb", b"\x00=\n\n", b"="])


def decode(data: bytes) -> list[tuple[str, bytes]]:
    """The protocol as its specification words it, apart from our own code."""
    fields = []
    while data:
        line, data = data.split(b"\n", 1)
        if b"=" in line:
            name, value = line.split(b"=", 1)
        else:
            name, size = line, int.from_bytes(data[:8], "little")
            value, end, data = data[8 : 8 + size], data[8 + size : 9 + size], data[9 + size :]
            assert end == b"\n"
        fields.append((name.decode(), value))
    return fields


@given(st.dictionaries(NAMES, VALUES))
def test_encode(fields: dict[str, bytes]) -> None:
    assert decode(encode_entry(fields)) == list(fields.items())


@given(st.text(max_size=80))
def test_text_and_numbers(text: str) -> None:
    encoded = decode(encode_entry({"A": text.encode("utf-8", "replace"), "B": 7}))
    assert encoded[1] == ("B", b"7")


@given(st.text(max_size=100), st.sampled_from(["DORA_", "DORA_FIELD_"]))
def test_legal_name(name: str, prefix: str) -> None:
    legal = legal_name(name, prefix)
    assert re.fullmatch(r"[A-Z][A-Z0-9_]{0,63}", legal)
    assert legal.startswith(prefix)


@given(
    st.lists(st.dictionaries(NAMES, VALUES, min_size=1, max_size=5), max_size=4),
    st.integers(1, 50),
)
def test_export_reader(entries: list[dict[str, bytes]], size: int) -> None:
    data = b"".join(encode_entry(entry) + b"\n" for entry in entries)
    reader = ExportReader()
    found = [
        entry
        for start in range(0, len(data), size)
        for entry in reader.feed(data[start : start + size])
    ]
    assert found == entries


def test_names_for_journald() -> None:
    assert legal_name("a b-ä.c", "DORA_") == "DORA_A_B_C"
    assert legal_name("", "DORA_") == "DORA_"
    assert legal_name("x" * 99, "DORA_") == "DORA_" + "X" * 59


def test_values() -> None:
    assert encode_entry({"A": "é\udcff", "B": 7, "C": b"\xfe"}) == b"A=\xc3\xa9\xff\nB=7\nC=\xfe\n"
    assert encode_entry({"A": "a\nb"}) == b"A\n\x03\0\0\0\0\0\0\0a\nb\n"


def test_names_and_repeated_fields_of_other_writers() -> None:
    found = ExportReader().feed(b"\n\nA=1\nA=2\n\xff=3\n\n")
    assert found == [{"A": b"2", "\ufffd": b"3"}]

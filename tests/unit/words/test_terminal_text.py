"""No text of others commands a terminal, wherever it is written."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.cli import edge
from dora_systemd.cli.edge import Edge, write_own
from dora_systemd.decisions.logs.terminal import ShownLines, TerminalLines
from dora_systemd.terminal_text import Display, escaped, one_line, shown_log, without_sequences
from tests.unit.checkout import linked_package

COMMANDING = {*range(0x20), *range(0x7F, 0xA0), 0x202E, 0x2066, 0x200F} - {9, 10}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain ünïcode 日本 🤖\tx\n", "plain ünïcode 日本 🤖\tx\n"),
        ("\x1b]52;c;cHduZWQ=\x07", r"\x1b]52;c;cHduZWQ=\x07"),
        ("\x1b]0;title\x1b\\", "\\x1b]0;title\\x1b\\"),
        ("\x9b31mred", r"\u009b31mred"),
        ("\x7f", r"\u007f"),
        ("over\rwritten\x08", r"over\x0dwritten\x08"),
        ("a\u202eb\u2066c\u200f", r"a\u202eb\u2066c\u200f"),
        ("\udcff", r"\udcff"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_escaped(text: str, shown: str) -> None:
    assert escaped(text) == shown


def test_one_line() -> None:
    assert one_line("a\nb\tc\x1b") == r"a b c\x1b"


@given(st.text())
def test_nothing_gets_through(text: str) -> None:
    assert not COMMANDING & set(map(ord, escaped(text)))


@given(st.dictionaries(st.text(), st.text()))
def test_json_stays_json(value: dict[str, str]) -> None:
    assert json.loads(escaped(json.dumps(value))) == value


@given(st.binary(max_size=200))
def test_no_bytes_get_through_but_colors(data: bytes) -> None:
    shown = shown_log(data + b"\x1b[31m" + data)
    text = shown.decode()  # it is UTF-8
    for color in ("\x1b[31m", "\x1b[0m"):
        text = text.replace(color, "")
    left = COMMANDING & set(map(ord, text))
    assert not left or (left == {0x1B} and b"\x1b[" in data)


@pytest.mark.parametrize(
    ("data", "shown"),
    [
        (b"\x1b[1;31mred", b"\x1b[1;31mred\x1b[0m"),
        (b"\x1b[32mgreen\x1b[0m\nplain\n", b"\x1b[32mgreen\x1b[0m\nplain\n"),
        (b"\x1b[2J\x1b[Hgone", rb"\x1b[2J\x1b[Hgone"),
        (b"\x9b2J", rb"\x9b2J"),
        (b"\xc2\x9b2J", rb"\u009b2J"),
        (b"dos\r\n", b"dos\n"),
        (b"50%\r100%\n", b"50%\\x0d100%\n"),
    ],
)
def test_lines_of_a_log(data: bytes, shown: bytes) -> None:
    assert shown_log(data) == shown


def test_a_record_on_a_terminal_and_in_a_pipe() -> None:
    record = {"SYSLOG_IDENTIFIER": b"robot/cam\x1b]0;x", "MESSAGE": b"\x1b]52;c;eA==\x07\n\x9b2J"}
    shown = TerminalLines().record(record)
    assert rb"\x1b]52;c;eA==\x07" in shown
    assert rb"cam\x1b]0;x" in shown
    assert rb"\x9b2J" in shown
    assert b"\x1b]52;c;eA==\x07\n" in TerminalLines(is_terminal=False).record(record)


def test_lines_of_other_forms() -> None:
    lines = ShownLines()
    fed = [lines.feed(part) for part in (b"one\x1b", b"]0;x\x07\ntw", b"o\n")]
    assert fed == [b"", b"one\\x1b]0;x\\x07\n", b"two\n"]


def test_without_sequences() -> None:
    assert without_sequences("\x1b[1mbold\x1b]0;t\x07 \x1b]8;;x\x1b\\link\x9b0m") == "bold link"


def test_the_edge_lets_only_our_own_through() -> None:
    raw = io.BytesIO()
    stream = Edge(raw, encoding="utf-8")
    print("\x1b]0;x\x07", file=stream)
    write_own(stream, "\x1b[1m")
    stream.flush()
    assert raw.getvalue() == b"\\x1b]0;x\\x07\n\x1b[1m"


def test_the_edge_is_put_before_both_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    edge.put_in_place()
    assert isinstance(sys.stdout, Edge)
    assert isinstance(sys.stderr, Edge)
    assert sys.stdout.errors == sys.stderr.errors == "backslashreplace"


def test_the_command_writes_through_it(tmp_path: Path) -> None:
    """An error names what was typed, or what somebody else has called his file."""
    environment = {**os.environ, "PYTHONPATH": str(linked_package(tmp_path))}
    done = subprocess.run(
        [
            sys.executable,
            "-P",
            "-m",
            "dora_systemd.cli.main",
            "start",
            "/no\x1b]0;x\x07/\u202e.yml",
        ],
        env=environment,
        capture_output=True,
        check=False,
    )
    assert done.returncode
    assert b"\x1b" not in done.stdout + done.stderr
    assert "\u202e".encode() not in done.stdout + done.stderr


FULL = "\x1b[?1049h\x1b[?1000h\x1b[?25l\x1b[2;3Hx\x1b[K"
QUERIES = ("\x1b[c", "\x1b[6n", "\x1b[21t", "\x1b[>q", "\x1b[?u", "\x1bP$qm\x1b\\", "\x05", "\x1bZ")


@pytest.mark.parametrize("is_full", [True, False])
@pytest.mark.parametrize("size", [1, 3, 1000])
def test_a_program_of_others_cannot_make_the_terminal_type(is_full: bool, size: int) -> None:
    orders = "a\x1b]52;c;cm0=\x07\x1b]0;t\x07\u202e\x9bc"
    display, sent = Display(), orders.join(QUERIES).encode()
    display.is_full = is_full
    parts = [display.show(sent[n : n + size]) for n in range(0, len(sent), size)]
    shown = (b"".join(parts) + display.end()).decode()
    assert "\x1b" not in shown
    assert not any(one in shown for one in ("\x05", "\u202e", "\x9b"))
    assert "\\x1b]52;c;cm0=" in shown


@pytest.mark.parametrize("size", [1, 2, 5, 1000])
def test_what_a_program_for_the_whole_screen_sends(size: int) -> None:
    sent = f"ä\U0001f916\x1b[1;31mred\r{FULL}\r\n".encode()
    for is_full in (True, False):
        display = Display()
        display.is_full = is_full
        shown = b"".join(display.show(sent[n : n + size]) for n in range(0, len(sent), size))
        assert shown.startswith("ä\U0001f916\x1b[1;31mred\r".encode())
        assert (shown == sent) == is_full
    assert display.end() == b"\x1b[0m"
    display.is_full = True
    display.show(FULL.encode())
    assert display.end() == b"\x1b[0m\x1b[?1000l\x1b[?1049l\x1b[?25h", "what is left on"

"""Lines for a terminal."""

import re

import pytest

from dora_systemd.decisions.logs.terminal import TerminalLines, color_of

SHORT = b"Nov 21 01:02:59 lab robot/camera[95]: "


def plain(data: bytes) -> bytes:
    return re.sub(rb"\x1b\[[0-9;:]*m", b"", data)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"Nov 21 01:02:59 lab robot/camera[95]: hi: x\n", b"Nov 21 01:02:59 camera   hi: x\n"),
        (b"Nov 21 01:02:59.123456 l robot/a[9]: \n", b"Nov 21 01:02:59.123456 a        \n"),
        (b"Nov 21 01:02:59 lab robot[95]: end\n", b"Nov 21 01:02:59 robot    end\n"),
        (b"Nov  1 01:02:59 lab robot[95]: x\n", b"Nov  1 01:02:59 robot    x\n"),
        (b"-- Boot 1234 --\n", b"-- Boot 1234 --\n"),
        (b"-- No entries --\n", b"-- No entries --\n"),
    ],
)
def test_line(line: bytes, expected: bytes) -> None:
    assert plain(TerminalLines(["camera", "detector"]).feed(line)) == expected


def test_several_dataflows() -> None:
    lines = TerminalLines(want_dataflow=True)
    assert plain(lines.feed(SHORT + b"hi\n")) == b"Nov 21 01:02:59 robot/camera hi\n"


def test_second_line_of_a_message_stays_below_the_first() -> None:
    data = SHORT + b"one\n" + b" " * len(SHORT) + b"  two\n"
    found = plain(TerminalLines(["detector"]).feed(data)).splitlines()
    assert found[1].index(b"two") == found[0].index(b"one") + 2


def test_chunks_make_no_difference() -> None:
    data = (SHORT + b"one\n" + SHORT + b"two\n") * 3
    whole = TerminalLines().feed(data)
    lines = TerminalLines()
    assert b"".join(lines.feed(data[i : i + 1]) for i in range(len(data))) == whole


def test_color_of_a_node_is_always_the_same() -> None:
    assert color_of("camera") == color_of("camera")
    assert len({color_of(f"node-{i}") for i in range(50)}) > 5


def test_no_colors() -> None:
    assert b"\x1b" not in TerminalLines(want_colors=False).feed(SHORT + b"x\n")


def test_record() -> None:
    record = {
        "__REALTIME_TIMESTAMP": b"1795222832065336",
        "SYSLOG_IDENTIFIER": b"robot/camera",
        "PRIORITY": b"3",
        "MESSAGE": b"one\ntwo",
    }
    lines = TerminalLines(["camera"])
    first, second = plain(lines.record(record)).decode().splitlines()
    assert re.fullmatch(r"Nov \d\d \d\d:\d\d:\d\d camera one", first)
    assert second == " " * len("Nov 21 00:00:00 camera ") + "two"
    assert b"\x1b[0;1;31mone" in lines.record(record)
    assert b"\x1b" not in TerminalLines(want_colors=False).record(record)
    assert TerminalLines().record({}).endswith(b"\n")

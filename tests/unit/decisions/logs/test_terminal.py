"""Lines for a terminal."""

import re

import pytest

from dora_systemd.decisions.logs.terminal import MOST_NAMES, TerminalLines, color_of

SHORT = b"Nov 21 01:02:59 lab robot/camera[95]: "


def fed(lines: TerminalLines, data: bytes) -> bytes:
    """All that becomes of `data`."""
    return lines.feed(data) + lines.flush()


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
    assert plain(fed(TerminalLines(["camera", "detector"]), line)) == expected


def test_several_dataflows() -> None:
    lines = TerminalLines(want_dataflow=True)
    assert plain(fed(lines, SHORT + b"hi\n")) == b"Nov 21 01:02:59 robot/camera hi\n"


def test_second_line_of_a_message_stays_below_the_first() -> None:
    data = SHORT + b"one\n" + b" " * len(SHORT) + b"  two\n"
    found = plain(fed(TerminalLines(["detector"]), data)).splitlines()
    assert found[1].index(b"two") == found[0].index(b"one") + 2


def test_second_line_below_a_coloured_first_one() -> None:
    """journalctl prints the name of a failed node in bold, and indents by what is visible."""
    first = b"Nov 21 01:02:59 lab \x1b[0;1;39mrobot/camera[95]\x1b[0m: one\n"
    data = first + b" " * (len(plain(first)) - len(b"one\n")) + b"  two\n"
    found = plain(fed(TerminalLines(["detector"]), data)).splitlines()
    assert found[0] == b"Nov 21 01:02:59 camera   one"
    assert found[1] == b" " * len(b"Nov 21 01:02:59 camera   ") + b"  two"


def test_chunks_make_no_difference() -> None:
    data = (SHORT + b"one\n" + SHORT + b"two\n") * 3 + (SHORT + b"one\n") * 5
    data += SHORT + b"one\n" + b" " * len(SHORT) + b"more\n"
    whole = fed(TerminalLines(), data)
    lines = TerminalLines()
    pieces = b"".join(lines.feed(data[i : i + 1]) for i in range(len(data)))
    assert pieces + lines.flush() == whole


def test_names_without_end_fill_no_memory() -> None:
    lines, shown = TerminalLines(), b""
    for number in range(2 * MOST_NAMES):
        shown += lines.feed(SHORT.replace(b"camera", b"n%d" % number) + b"one\n")
        assert len(lines._said) <= MOST_NAMES
        assert len(lines._labels) <= MOST_NAMES
    assert (shown + lines.flush()).count(b" one\n") == 2 * MOST_NAMES


def test_long_names_and_texts_are_not_kept() -> None:
    lines = TerminalLines()
    long = SHORT.replace(b"camera", b"n" * 1000) + b"one\n"
    found = fed(lines, long * 2 + (SHORT + b"x" * 20_000 + b"\n") * 2)
    assert found.count(b"one\n") == 2
    assert found.count(b"x" * 20_000) == 2
    lines.feed(long * 3)
    assert not lines._said
    assert list(lines._labels) == [b"camera"]


def test_repetitions_are_told_before_they_are_forgotten() -> None:
    lines = TerminalLines()
    others = b"".join(SHORT.replace(b"camera", b"n%d" % n) + b"hi\n" for n in range(MOST_NAMES))
    assert b"camera ... the same line, 4 times in all\n" in plain(
        fed(lines, (SHORT + b"one\n") * 4 + others)
    )


def test_color_of_a_node_is_always_the_same() -> None:
    assert color_of("camera") == color_of("camera")
    assert len({color_of(f"node-{i}") for i in range(50)}) > 5


def test_no_colors() -> None:
    assert b"\x1b" not in fed(TerminalLines(want_colors=False), SHORT + b"x\n")


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


def line(node: str, text: str, second: int = 0) -> bytes:
    return f"Nov 21 01:02:{second:02} lab robot/{node}[95]: {text}\n".encode()


def texts(data: bytes, has_events: bool = False) -> list[str]:
    """What is shown: seconds, node and text."""
    lines = TerminalLines(["camera"], want_colors=False, has_events=has_events)
    return [one[13:] for one in fed(lines, data).decode().splitlines()]


def test_repetitions_are_counted_by_node() -> None:
    """Other nodes may say something meanwhile. The count stands where the last one stood."""
    data = b"".join(line("camera", "slow", i) + line("sink", "idle", i) for i in range(5))
    assert texts(data + line("camera", "fast", 7)) == [
        *("00 camera slow", "00 sink   idle"),
        *(
            "04 camera ... the same line, 5 times in all",
            "07 camera fast",
            "04 sink   ... the same line, 5 times in all",
        ),
    ]


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (["a", "a"], ["a", "a"]),
        (["a", "b", "a"], ["a", "b", "a"]),
        (["line 1", "line 2", "line 3"], ["line 1", "line 2", "line 3"]),
        (
            ["07:50:52,123 x", "07:50:53,004 x", "07:51:00,999 x"],
            ["07:50:52,123 x", "... the same line, 3 times in all"],
        ),
        (
            ["2026-11-21T07:50:52.1Z x"] * 3,
            ["2026-11-21T07:50:52.1Z x", "... the same line, 3 times in all"],
        ),
        (["at 07:50:52 1", "at 07:50:53 2"], ["at 07:50:52 1", "at 07:50:53 2"]),
    ],
)
def test_what_is_the_same_line(said: list[str], shown: list[str]) -> None:
    found = texts(b"".join(line("camera", text) for text in said))
    assert found == [f"00 camera {text}" for text in shown]


def test_what_an_event_says_is_said_once() -> None:
    crash = "node_failure: dora_daemon::spawn::prepared: node exited with error: ExitCode(1)"
    data = line("daemon", crash) + line("camera", "Node camera crashed: exit code 1")
    assert texts(data, has_events=True) == ["00 camera Node camera crashed: exit code 1"]
    assert len(texts(data)) == 2
    assert len(texts(line("camera", crash) + line("daemon", "other"), has_events=True)) == 2


def test_a_line_of_other_bytes_that_comes_again() -> None:
    """Which is no text, as of a node that writes Latin-1, in a name and in a message."""
    again = SHORT.replace(b"camera", b"k\xfcche") + b"gr\xfc\xdf\n"
    found = plain(fed(TerminalLines(), again * 3)).splitlines()
    assert len(found) == 2
    assert found[1] == rb"Nov 21 01:02:59 k\xfcche ... the same line, 3 times in all"

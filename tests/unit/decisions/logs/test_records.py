"""Records in dora's form, which lines are the same, and how many of them may pass."""

import json

import pytest

from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.decisions.logs.limiter import LineLimiter
from dora_systemd.decisions.logs.noise import is_end_of, is_same, is_told_by_event, repeated
from dora_systemd.decisions.logs.records import (
    DoraLines,
    Record,
    level_of,
    log_payload,
    record_text,
    timestamp,
)
from dora_systemd.values import SECOND

LINE = {
    **{"DORA_NODE": b"camera", "DORA_STREAM": b"stderr", "MESSAGE": b"caf\xc3\xa9 \xff"},
    **{"PRIORITY": b"6", "__REALTIME_TIMESTAMP": b"1795298412065336"},
}
NONE = dict.fromkeys(("build_id", "daemon_id", "module_path", "file", "line", "fields"))


def test_a_raw_line_as_dora_has_it() -> None:
    assert log_payload(LINE, "u") == {
        **NONE,
        **{"dataflow_id": "u", "node_id": "camera", "level": "stdout", "target": None},
        **{"message": "café \ufffd", "timestamp": timestamp(LINE)},
    }


def test_a_record_with_a_level_and_a_target() -> None:
    record = {**LINE, "DORA_LEVEL": b"trace", "DORA_TARGET": b"my.target"}
    found = log_payload(record, "u")
    assert (found["level"], found["target"]) == ("TRACE", "my.target")


def test_a_life_event() -> None:
    found = log_payload({"PRIORITY": b"3"}, "u")
    assert (found["level"], found["target"], found["node_id"]) == ("ERROR", "dora-systemd", None)
    assert (found["message"], found["timestamp"]) == ("", timestamp({}))


def test_when_a_record_came() -> None:
    assert timestamp(LINE).startswith("2026-11-21T22:00:12.065336")
    assert timestamp({}).startswith("1970-01-01T00:00:00")
    assert record_text(LINE, "OTHER") == ""


@pytest.mark.parametrize(
    ("record", "level"),
    [
        *(({"PRIORITY": one}, "error") for one in (b"0", b"1", b"2", b"3")),
        *(({"PRIORITY": b"4"}, "warn"), ({"PRIORITY": b"5"}, "info"), ({}, "info")),
        *(({"PRIORITY": b"6"}, "info"), ({"PRIORITY": b"7"}, "debug")),
        ({"PRIORITY": b"3", "DORA_STREAM": b"stdout"}, "stdout"),
        ({"PRIORITY": b"3", "DORA_STREAM": b"stdout", "DORA_LEVEL": b"loud"}, "stdout"),
        ({"PRIORITY": b"3", "DORA_STREAM": b"stdout", "DORA_LEVEL": b"debug"}, "debug"),
    ],
)
def test_levels(record: Record, level: str) -> None:
    assert level_of(record) == level


def test_forms() -> None:
    line = DoraLines("json", "u", is_terminal=False).record(LINE)
    assert line == json.dumps(log_payload(LINE, "u"), separators=(",", ":")).encode() + b"\n"
    compact = DoraLines("compact", "u", is_terminal=True).record({**LINE, "MESSAGE": b"a\x1bb"})
    assert compact.endswith(b" STDOUT camera: a\\x1bb\n")
    assert len(compact.split(b" ")[0]) == len("22:00:12")


@pytest.mark.parametrize(
    ("one", "other", "are_same"),
    [
        *((b"a", b"a", True), (b"a", b"b", False), (b"a", b"ab", False), (b"", b"", True)),
        (b"07:50:52 x", b"07:50:53 x", True),
        (b"07:50:52.1 x", b"07:50:53.9 x", True),
        (b"07:50:52,123 x", b"07:50:53.999 x", True),
        (b"2026-11-21 07:50:52 x", b"2026-11-22 07:50:53 x", True),
        (b"2026-11-21T07:50:52 x", b"2027-12-31T00:00:00 x", True),
        (b"2026-11-21_07:50:52 x", b"2026-11-22_07:50:52 x", False),
        (b"07:50:52 x", b"07:50:53 y", False),
        (b"07:50:52.1 x", b"07:50:52.12x", False),
        (b"7:50:52 x", b"8:50:52 x", False),
        (b"12 x", b"13 x", False),
    ],
)
def test_which_lines_are_the_same(one: bytes, other: bytes, are_same: bool) -> None:
    assert is_same(one, other) is is_same(other, one) is are_same


@pytest.mark.parametrize(
    ("times", "shown"), [(1, ""), (2, "a"), (3, "... 3 times"), (99, "... 99 times")]
)
def test_how_often_a_line_came(times: int, shown: str) -> None:
    assert repeated("a", times) == shown


CRASH = "run: node_failure: dora_daemon::spawn: failed dataflow_id=u node_id=camera x"


@pytest.mark.parametrize(
    ("text", "nodes", "is_one"),
    [
        *((CRASH, ["camera"], True), (CRASH, ["plot", "camera"], True), (CRASH, ["plot"], False)),
        *((CRASH, [], False), (CRASH, ["cam"], False)),
        (CRASH.replace("node_failure: ", ""), ["camera"], False),
        (CRASH.replace("node_id=", "a_node_id="), ["camera"], False),
    ],
)
def test_whose_end_a_line_tells(text: str, nodes: list[str], is_one: bool) -> None:
    assert is_end_of(text, nodes) is is_one


@pytest.mark.parametrize(
    ("origin", "text", "is_told"),
    [
        *((b"daemon", CRASH, True), (b"robot/daemon", CRASH, True), (b"a/b/daemon", CRASH, True)),
        *((b"robot/camera", CRASH, False), (b"daemon/camera", CRASH, False)),
        *((b"my-daemon", CRASH, False), (b"robot/daemon", "failed", False)),
    ],
)
def test_what_an_event_tells_too(origin: bytes, text: str, is_told: bool) -> None:
    assert is_told_by_event(origin, text.encode()) is is_told


def test_a_window_of_each_stream() -> None:
    limiter = LineLimiter(RateLimit(3, 2 * SECOND))
    assert limiter.admit("stdout", 2, 10.0) == 2
    assert limiter.end("stdout") == 12.0
    assert limiter.admit("stdout", 2, 11.0) == 1
    assert limiter.admit("stdout", 5, 11.9) == 0
    assert limiter.admit("stderr", 4, 11.9) == 3
    assert (limiter.end("stdout"), limiter.end("stderr")) == (12.0, 13.9)
    assert limiter.suppressed == 7
    assert (limiter.take_suppressed(), limiter.take_suppressed()) == (7, 0)
    assert limiter.admit("stdout", 3, 12.0) == 3
    assert limiter.end("stdout") == 14.0

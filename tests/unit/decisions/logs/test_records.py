"""Records in the form of dora's log stream, and which of them are shown."""

import json

import pytest

from dora_systemd.decisions.cell.line_rates import LineLimiter, RateLimit
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.gateway.answers import log_line
from dora_systemd.decisions.gateway.page_messages import line_values
from dora_systemd.decisions.logs.noise import is_end_of, is_same, is_told_by_event, repeated
from dora_systemd.decisions.logs.records import (
    DoraLines,
    LogFilter,
    Record,
    level_of,
    lines_elsewhere,
    log_payload,
    parse_filter,
    record_text,
    timestamp,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
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
    ("times", "shown"),
    [
        (1, ""),
        (2, "a"),
        (3, "... the same line, 3 times in all"),
        (99, "... the same line, 99 times in all"),
    ],
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


def test_whose_end_a_line_tells_by_the_beginning_of_an_id() -> None:
    assert is_end_of(CRASH, [], ("plot", "cam"))
    assert not is_end_of(CRASH, [], ("plot", "amera"))


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


RAW = {"DORA_NODE": b"camera", "DORA_STREAM": b"stdout", "PRIORITY": b"6", "MESSAGE": b"a\x1bb"}
DEBUG = {**RAW, "DORA_LEVEL": b"debug", "PRIORITY": b"7"}
WARNING = {**RAW, "DORA_LEVEL": b"warn", "DORA_NODE": b"sink"}
EVENT = {"PRIORITY": b"3", "MESSAGE": b"dataflow failed", "__REALTIME_TIMESTAMP": b"0"}
ALL = [RAW, DEBUG, WARNING, EVENT]


@pytest.mark.parametrize(
    ("level", "nodes", "shown"),
    [
        ("stdout", "", ALL),
        ("trace", "", [DEBUG, WARNING, EVENT]),
        ("info", "", [WARNING, EVENT]),
        ("error", "", [EVENT]),
        ("error", "camera=debug", [DEBUG, EVENT]),
        ("error", "camera = STDOUT , sink=warn,", ALL),
        ("stdout", "camera=error", [WARNING, EVENT]),
    ],
)
def test_what_is_shown(level: str, nodes: str, shown: list[dict[str, bytes]]) -> None:
    wanted = LogFilter(level, parse_filter(nodes))
    assert [one for one in ALL if wanted.shows(one)] == shown


@pytest.mark.parametrize("text", ["camera", "camera=loud", "=info", "a=info,b"])
def test_no_filter(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="as a log filter") as caught:
        parse_filter(text)
    assert caught.value.code is ExitCode.USAGE
    assert "error, warn, info, debug, trace, stdout" in caught.value.hint


def test_lines_of_the_dora_command() -> None:
    line = json.loads(DoraLines("json", "u-1", is_terminal=False).record(DEBUG))
    assert (line["dataflow_id"], line["node_id"], line["level"]) == ("u-1", "camera", "DEBUG")
    compact = DoraLines("compact", "u-1", is_terminal=False)
    assert compact.record(EVENT).endswith(b":00 ERROR dora: dataflow failed\n")
    assert compact.record(RAW).endswith(b" STDOUT camera: a\x1bb\n")


def test_a_terminal_gets_no_control_characters() -> None:
    for form in ("json", "compact"):
        assert b"\x1b" not in DoraLines(form, "u-1", is_terminal=True).record(RAW)


def test_the_words_for_no_filter() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_filter("a=info, camera = loud ")
    assert caught.value.message == "cannot read 'camera = loud' as a log filter"
    levels = "error, warn, info, debug, trace, stdout"
    assert caught.value.hint == f"write NODE=LEVEL,...; levels: {levels}"
    assert parse_filter(" a = INFO ,, b=Stdout") == {"a": "info", "b": "stdout"}
    assert parse_filter("") == {}


@pytest.mark.parametrize("level", ["error", "warn", "info", "debug", "trace"])
def test_a_level_shows_itself_and_what_is_worse(level: str) -> None:
    levels = ["error", "warn", "info", "debug", "trace"]
    records = [{"DORA_LEVEL": one.encode()} for one in levels]
    shown = [record for record in records if LogFilter(level).shows(record)]
    assert shown == records[: levels.index(level) + 1]
    assert not LogFilter(level).shows(RAW)
    assert LogFilter().shows(RAW)


PLACED = (Placed("mid", "gpu"), Placed("eye", "cam"), Placed("ear", "cam"))


@pytest.mark.parametrize(
    ("node", "text"),
    [
        ("", "more lines are in the journal of machines gpu, cam: doractl logs robot"),
        ("eye", "more lines are in the journal of machine cam: doractl logs robot --node eye"),
    ],
)
def test_all_are_told(node: str, text: str) -> None:
    (record,) = lines_elsewhere("robot", PLACED, node, 17_000_000)
    line = line_values(record)
    assert (line["at_us"], line["node"], line["text"]) == (17_000_000, node, text)
    assert text in log_line(record).decode()
    assert log_payload(record, "u")["message"] == text


def test_a_node_of_the_head() -> None:
    assert lines_elsewhere("robot", PLACED, "camera", 17) == []
    assert lines_elsewhere("robot", (), "", 17) == []

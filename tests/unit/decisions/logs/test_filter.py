"""Which records `doractl run` prints, and in which form."""

import json

import pytest

from dora_systemd.decisions.logs.filter import LogFilter, parse_filter
from dora_systemd.decisions.logs.records import DoraLines
from dora_systemd.errors import DoraSystemdError, ExitCode

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

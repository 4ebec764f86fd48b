"""What doractl logs asks of journalctl."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.logs.journal_events import EVENTS, REQUESTS
from dora_systemd.decisions.logs.query import (
    UNIT_FAILED,
    UNIT_STARTING,
    LogQuery,
    end_matches,
    failure_matches,
    is_boot,
    journal_time,
    journal_timestamp,
    parse_level,
    query_arguments,
    query_matches,
    request_matches,
    scope_matches,
    start_matches,
    story_matches,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope

SYSTEM = Scope(is_user=False, uid=0)
USER = Scope(is_user=True, uid=1000)


def test_all_dataflows() -> None:
    assert query_matches(LogQuery(SYSTEM)) == ["_SYSTEMD_SLICE=dora.slice"]
    assert query_matches(LogQuery(USER)) == ["_SYSTEMD_USER_SLICE=dora.slice", "_UID=1000"]


def test_one_dataflow() -> None:
    assert query_matches(LogQuery(SYSTEM, name="robot")) == ["_SYSTEMD_UNIT=dora-robot.service"]
    query = LogQuery(USER, name="robot", uuid="U", invocation="I", run="R", nodes=("a", "b"))
    assert query_matches(query) == [
        "_SYSTEMD_USER_UNIT=dora-robot.service",
        "_UID=1000",
        "DORA_DATAFLOW=U",
        "_SYSTEMD_INVOCATION_ID=I",
        "DORA_RUN=R",
        "DORA_NODE=a",
        "DORA_NODE=b",
    ]


def test_events() -> None:
    assert len(query_matches(LogQuery(SYSTEM, is_events=True))) == 1 + len(EVENTS)


@pytest.mark.parametrize(
    ("level", "priorities"),
    [("error", 4), ("warn", 5), ("notice", 6), ("info", 7), ("stdout", 0), ("trace", 0), ("", 0)],
)
def test_level(level: str, priorities: int) -> None:
    matches = query_matches(LogQuery(SYSTEM, level=level))
    assert matches[1:] == [f"PRIORITY={number}" for number in range(priorities)]


def test_debug_leaves_out_trace() -> None:
    matches = query_matches(LogQuery(SYSTEM, name="robot", level="debug"))
    assert matches[-4:] == [
        "+",
        "_SYSTEMD_UNIT=dora-robot.service",
        "PRIORITY=7",
        "DORA_LEVEL=debug",
    ]


def test_arguments() -> None:
    query = LogQuery(
        SYSTEM, since="5m", until="now", grep="-x", tail="0", boot="-1", is_follow=True
    )
    assert query_arguments(query) == [
        "--output=short",
        "--boot=-1",
        "--since=-5m",
        "--until=now",
        "--grep=-x",
        "--lines=0",
        "--follow",
        "--",
        "_SYSTEMD_SLICE=dora.slice",
    ]


@pytest.mark.parametrize("output", ["json", "cat", "export"])
def test_programs_get_records_only(output: str) -> None:
    assert "--quiet" in query_arguments(LogQuery(SYSTEM, output=output))
    assert "--quiet" in query_arguments(LogQuery(SYSTEM, is_quiet=True))


ROBOT = "_SYSTEMD_UNIT=dora-robot.service"


def test_several_dataflows() -> None:
    arm = LogQuery(SYSTEM, name="arm", nodes=("hand",))
    matches = query_matches(LogQuery(SYSTEM, name="robot", others=(arm, arm)))
    other = ["_SYSTEMD_UNIT=dora-arm.service", "DORA_NODE=hand"]
    assert matches == [ROBOT, "+", *other, "+", *other]


def test_levels_by_node() -> None:
    """Each node from its level on; the others, and the dataflow itself, from that for all."""
    levels = {"camera": "emerg", "plot": "emerg", "detector": "stdout"}
    nodes = ("", "camera", "detector", "plot", "sink")
    query = LogQuery(SYSTEM, name="robot", nodes=nodes, level="alert", levels=levels)
    alert = ["PRIORITY=0", "PRIORITY=1"]
    assert query_matches(query) == [
        *(ROBOT, "SYSLOG_IDENTIFIER=robot", *alert, "+"),
        *(ROBOT, "DORA_NODE=camera", "DORA_NODE=plot", "PRIORITY=0", "+"),
        *(ROBOT, "DORA_NODE=detector", "+"),
        *(ROBOT, "DORA_NODE=sink", *alert),
    ]


@pytest.mark.parametrize(
    ("text", "is_one"),
    [
        *((word, True) for word in ("0", "-1", "+2", "12", "all", "a" * 32, "a" * 32 + "-1")),
        *((word, False) for word in ("", "robot", "-f", "--follow", "a" * 31, "1x", "-")),
    ],
)
def test_boot(text: str, is_one: bool) -> None:
    assert is_boot(text) is is_one


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *(("5m", "-5m"), ("1.5h", "-1.5h"), ("10s", "-10s"), ("today", "today")),
        *(("10 min ago", "10 min ago"), ("-5m", "-5m"), ("2026-11-20 18:00", "2026-11-20 18:00")),
        *(("", ""), ("m", "m"), ("12", "12"), ("@5", "@5")),
    ],
)
def test_time(text: str, expected: str) -> None:
    assert journal_time(text) == expected


@given(st.text(max_size=30))
def test_any_time(text: str) -> None:
    assert journal_time(text) in (text, "-" + text)


def test_unknown_level() -> None:
    assert parse_level("WARN") == "warn"
    with pytest.raises(DoraSystemdError) as caught:
        parse_level("loud")
    assert caught.value.code is ExitCode.USAGE


def test_end_of_unit() -> None:
    assert end_matches(SYSTEM, "robot")[:2] == ["UNIT=dora-robot.service", "_PID=1"]
    assert end_matches(USER, "robot")[:2] == ["USER_UNIT=dora-robot.service", "_UID=1000"]


UID = "550e8400-e29b-41d4-a716-446655440000"
ROOTS, ANNS = Scope(is_user=False, uid=0), Scope(is_user=True, uid=1000)


def test_whose_records_a_question_finds() -> None:
    """A user can write any field but those with an underscore, which journald sets."""
    unit = "dora-robot.service"
    starting = f"MESSAGE_ID={UNIT_STARTING}"
    assert start_matches(ROOTS, "robot") == [f"UNIT={unit}", "_PID=1", starting]
    assert start_matches(ANNS, "robot") == [f"USER_UNIT={unit}", "_UID=1000", starting]
    ours = [f"DORA_DATAFLOW={UID}", "DORA_DATAFLOW=other"]
    failed = ["_PID=1", f"MESSAGE_ID={UNIT_FAILED}", *ours]
    assert failure_matches([UID, "other"]) == failed
    asked = ["DORA_EVENT=a", "DORA_EVENT=b"]
    assert request_matches(ROOTS, "a", "b") == [*asked, "_UID=0", "DORA_SCOPE=system"]
    assert request_matches(ANNS, "a", "b") == [*asked, "_UID=1000", "DORA_SCOPE=user"]


@pytest.mark.parametrize("scope", [ROOTS, ANNS])
def test_a_story_has_three_sources(scope: Scope) -> None:
    found = " ".join(story_matches(scope, "robot", UID)).split(" + ")
    own, systemds, requests = (one.split(" ") for one in found)
    events = [f"MESSAGE_ID={kind.message_id}" for kind in EVENTS.values()]
    assert own == [*scope_matches(scope, "robot"), f"DORA_DATAFLOW={UID}", *events]
    assert [*systemds, f"MESSAGE_ID={UNIT_STARTING}"] == start_matches(scope, "robot")
    asked = [f"DORA_EVENT={event}" for event in REQUESTS]
    assert requests == [f"DORA_DATAFLOW={UID}", *asked, f"_UID={scope.uid}"]


def test_all_arguments() -> None:
    query = LogQuery(SYSTEM, until="5m", is_reverse=True, want_unprintable=True, cursor_file="/c")
    assert query_arguments(query) == [
        *("--output=short", "--quiet", "--until=-5m", "--cursor-file=/c", "--reverse", "--all"),
        *("--", "_SYSTEMD_SLICE=dora.slice"),
    ]
    assert query_arguments(LogQuery(SYSTEM, output="short-precise"))[1] == "--"


@pytest.mark.parametrize(("tail", "is_counted"), [("", False), ("all", False), ("0", True)])
def test_whether_only_the_last_ones_are_wanted(tail: str, is_counted: bool) -> None:
    assert LogQuery(SYSTEM, tail=tail).is_counted is is_counted


@pytest.mark.parametrize(
    ("us", "text"), [(0, "@0.000000"), (1_000_001, "@1.000001"), (999_999, "@0.999999")]
)
def test_a_moment(us: int, text: str) -> None:
    assert journal_timestamp(us) == text


def test_both_ends_of_a_unit() -> None:
    ids = ["MESSAGE_ID=7ad2d189f7e94e70a38c781354912448", f"MESSAGE_ID={UNIT_FAILED}"]
    assert end_matches(SYSTEM, "robot") == ["UNIT=dora-robot.service", "_PID=1", *ids]


def test_the_words_for_an_unknown_level() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_level("Loud")
    assert caught.value.message == "cannot use 'Loud' as a level"
    known = "error, warn, info, debug, trace, stdout; those of syslog are understood too"
    assert caught.value.hint == f"one of {known}"


def test_debug_with_nodes_and_all_before_it() -> None:
    found = query_matches(LogQuery(SYSTEM, name="robot", nodes=("a",), level="debug"))
    info = [f"PRIORITY={number}" for number in range(7)]
    node = [ROBOT, "DORA_NODE=a"]
    assert found == [*node, *info, "+", *node, "PRIORITY=7", "DORA_LEVEL=debug"]

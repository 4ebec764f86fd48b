"""What a notice reports: read from the journal, whatever nodes and clocks have written there."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import checked_variable
from dora_systemd.decisions.cell.environment_file import parse_environment_file
from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.logs.query import (
    PROCESS_EXITED,
    UNIT_FAILED,
    UNIT_STARTING,
    UNIT_STOPPING,
)
from dora_systemd.decisions.notice.happened import (
    FIRST_PAUSE,
    LAST_PAUSE,
    LOOK_BACK,
    MOST_RECORDS,
    Happened,
    Sent,
    format_environment,
    has_lost_power,
    main_one,
    next_pause,
    pause_left,
    read_last,
    read_story,
    summary,
    variables,
)
from dora_systemd.values import SECOND

NOW = 1000 * SECOND
UUID, OTHER = "3fa85f64-5717-4562-b3fc-2c963f66afa6", "550e8400-e29b-41d4-a716-446655440001"


def record(seconds: float, **fields: str) -> dict[str, Any]:
    us = str(int(seconds * SECOND))
    return {"_BOOT_ID": "b", "__MONOTONIC_TIMESTAMP": us, "__REALTIME_TIMESTAMP": us, **fields}


def unit_failed(seconds: float, life: str) -> dict[str, Any]:
    return record(seconds, MESSAGE_ID=UNIT_FAILED, INVOCATION_ID=life)


def failed(seconds: float, life: str, reason: str) -> dict[str, Any]:
    own = {"_SYSTEMD_INVOCATION_ID": life, "DORA_REASON": reason, "DORA_NODES": "camera sink"}
    return record(seconds, DORA_EVENT="dataflow-failed", **own)


def sent(seconds: float, until: float, event: str = "notice-sent") -> dict[str, Any]:
    told = {"DORA_UNTIL": str(int(until * SECOND)), "DORA_PAUSE": str(30 * SECOND)}
    return record(seconds, DORA_EVENT=event, **told)


NOW_STARTED = record(3, DORA_EVENT="dataflow-started")
STARTED = {**record(900, DORA_EVENT="dataflow-started"), "_BOOT_ID": "a"}
WRITTEN = record(5, DORA_EVENT="bundle-written", DORA_FILE="/x/robot-1-power-lost.tar")
UNIT_ENDED = "7ad2d189f7e94e70a38c781354912448"


@pytest.mark.parametrize(
    ("newest", "is_lost"),
    [
        ([], True),
        ([NOW_STARTED], True),
        ([WRITTEN, NOW_STARTED], False),
        ([record(5, DORA_EVENT="bundle-written", DORA_FILE="/x/robot-1-failed.tar")], True),
        ([{**record(950, DORA_EVENT="dataflow-stopping"), "_BOOT_ID": "a"}], False),
        ([{**record(950, DORA_EVENT="dataflow-failed"), "_BOOT_ID": "a"}], False),
        ([{**record(950, MESSAGE_ID=UNIT_ENDED), "_BOOT_ID": "a"}], False),
        ([{**record(950, DORA_EVENT="dataflow-starting"), "_BOOT_ID": "a"}], True),
    ],
)
def test_what_ran_when_the_power_failed(newest: list[dict[str, Any]], is_lost: bool) -> None:
    assert has_lost_power([*newest, STARTED], "b") == is_lost


def test_nothing_ran_before_this_boot() -> None:
    assert not has_lost_power([NOW_STARTED], "b")
    assert not has_lost_power([NOW_STARTED] * 1000 + [STARTED], "b")


def test_each_failure_of_the_unit_counts_once_with_its_cause() -> None:
    records = [
        unit_failed(999, "2"),
        failed(998, "2", "node camera: exit code 2"),
        unit_failed(997, "1"),
        failed(996, "1", "node camera: exit code 1"),
    ]
    found, last = read_story(records, "b", NOW)
    assert last is None
    assert [(one.node, one.cause) for one in found] == [
        ("camera", "node camera: exit code 2"),
        ("camera", "node camera: exit code 1"),
    ]


def test_a_bundle_of_a_failure_counts_as_a_notice_and_a_requested_one_does_not() -> None:
    requested = record(998, DORA_EVENT="bundle-written", DORA_FILE="/x")
    assert len(read_story([requested, unit_failed(997, "1")], "b", NOW)[0]) == 1
    last = read_last([requested, sent(997, 996)], "b", NOW)
    assert last
    assert last.mono_us == 997 * SECOND
    for event in ("bundle-written", "bundle-refused"):
        found, last = read_story([sent(998, 997, event), unit_failed(997, "1")], "b", NOW)
        assert found == []
        assert last
        assert last.mono_us == 998 * SECOND


def killed(seconds: float, life: str, reason: str = BY_SIGKILL) -> list[dict[str, Any]]:
    """What systemd and ExecStopPost= write about a life that SIGKILL has ended, newest first."""
    exited = {"MESSAGE_ID": PROCESS_EXITED, "INVOCATION_ID": life}
    return [
        unit_failed(seconds, life),
        {**failed(seconds, life, reason), "DORA_DATAFLOW": UUID},
        record(seconds - 1, **exited),
    ]


def stop_asked(seconds: float, uuid: str = UUID) -> dict[str, Any]:
    return record(seconds, DORA_EVENT="stop-asked", DORA_DATAFLOW=uuid)


def unit_stopping(seconds: float, life: str) -> dict[str, Any]:
    return record(seconds, MESSAGE_ID=UNIT_STOPPING, INVOCATION_ID=life)


def unit_starting(seconds: float, life: str) -> dict[str, Any]:
    return record(seconds, MESSAGE_ID=UNIT_STARTING, INVOCATION_ID=life)


@pytest.mark.parametrize(
    ("records", "lives"),
    [
        ([*killed(999, "2"), stop_asked(996), unit_starting(990, "2")], 0),
        ([*killed(999, "2"), stop_asked(996)], 0),
        ([*killed(999, "2"), unit_starting(997, "2"), stop_asked(996)], 1),
        ([*killed(999, "2"), stop_asked(996, OTHER)], 1),
        ([*killed(999, "2"), stop_asked(996, "")], 1),
        ([*killed(999, "2", f"{BY_SIGKILL}, out of memory"), stop_asked(996)], 1),
        ([*killed(999, "2")[:2], stop_asked(998.5), *killed(999, "2")[2:]], 1),
        ([*killed(999, "2"), stop_asked(996), *killed(995, "1"), unit_starting(990, "1")], 1),
        ([stop_asked(999.5), *killed(999, "1")], 1),
        ([*killed(999, "2"), unit_stopping(996, "2")], 0),
        ([*killed(999, "2")[:2], unit_stopping(998.5, "2"), *killed(999, "2")[2:]], 1),
        ([*killed(999, "2"), unit_stopping(996, "1")], 1),
    ],
)
def test_a_kill_that_was_requested_is_no_failure(records: list[dict[str, Any]], lives: int) -> None:
    assert len(read_story(records, "b", NOW)[0]) == lives


def test_a_failure_that_the_runner_could_not_record() -> None:
    (one,) = read_story([unit_failed(999, "1")], "b", NOW)[0]
    assert (one.what, one.node, one.cause) == ("failed", "", "")
    of_systemd = {**unit_failed(999, "1"), "UNIT_RESULT": "oom-kill"}
    (one,) = read_story([of_systemd], "b", NOW)[0]
    assert one.cause == "it ran out of memory"
    (one,) = read_story([of_systemd, failed(998, "1", "the daemon is gone")], "b", NOW)[0]
    assert one.cause == "the daemon is gone"


@pytest.mark.parametrize(
    ("of_systemd", "of_runner", "uuid"),
    [(UUID, "", UUID), ("", UUID, UUID), (UUID, OTHER, UUID), ("", "", ""), ("x", "", "")],
)
def test_which_dataflow_of_that_name_has_failed(of_systemd: str, of_runner: str, uuid: str) -> None:
    """A user's manager does not record that."""
    end = {**unit_failed(999, "1"), **({"DORA_DATAFLOW": of_systemd} if of_systemd else {})}
    own = {**failed(998, "1", "exit code 1"), "DORA_DATAFLOW": of_runner}
    ((one,), _) = read_story([end, own], "b", NOW)
    assert one.uuid == uuid


def test_only_what_came_after_the_last_notice() -> None:
    """Also what came while that notice was sent."""
    records = [
        unit_failed(999, "4"),
        sent(998, 996),
        unit_failed(997, "3"),
        unit_failed(996, "2"),
        sent(995, 990),
        unit_failed(994, "1"),
    ]
    found, last = read_story(records, "b", NOW)
    assert [one.at_us // SECOND for one in found] == [999, 997]
    assert last == Sent(998 * SECOND, 996 * SECOND, 30 * SECOND)


def test_a_notice_that_has_failed_counts_as_one() -> None:
    records = [sent(998, 997, "notice-failed"), unit_failed(997, "1")]
    assert read_story(records, "b", NOW)[0] == []


def test_nothing_of_another_boot_and_nothing_old() -> None:
    assert read_story([{**unit_failed(999, "1"), "_BOOT_ID": "a"}], "b", NOW)[0] == []
    old = NOW / SECOND - LOOK_BACK / SECOND
    assert read_story([unit_failed(old, "1")], "b", NOW)[0] == []
    assert len(read_story([unit_failed(old + 1, "1")], "b", NOW)[0]) == 1


def test_a_pause_that_is_longer_than_the_look_back() -> None:
    """In a long storm a notice has all failures since the one before, and the pause still grows."""
    notice = sent(500, 499)
    last = read_last([notice], "b", NOW)
    assert last == Sent(500 * SECOND, 499 * SECOND, 30 * SECOND)
    records = [*(unit_failed(one, "1") for one in range(998, 400, -2)), notice]
    found, same = read_story(records, "b", NOW, last)
    assert same == last
    assert len(found) == 250
    assert read_last([{**notice, "_BOOT_ID": "a"}], "b", NOW) is None
    assert read_last([notice], "b", 501 * SECOND + 2 * LAST_PAUSE) is None


def test_a_flood_of_records_does_not_hide_the_last_notice() -> None:
    flood = [record(999, DORA_EVENT="node-given-up", DORA_NODE="a") for _ in range(MOST_RECORDS)]
    last = read_last([sent(998, 997)], "b", NOW)
    found, same = read_story([*flood, sent(998, 997)], "b", NOW, last)
    assert (len(found), same) == (MOST_RECORDS, last)
    assert pause_left(same, NOW) == 28 * SECOND


def test_other_failures() -> None:
    records = [
        record(999, DORA_EVENT="node-given-up", DORA_NODE="camera", DORA_REASON="exit code 1"),
        record(998, DORA_EVENT="machine-lost", DORA_MACHINE="gpu", DORA_REASON="no answer"),
        record(997, DORA_EVENT="release-rolled-back", DORA_NODES="sink", DORA_REASON="slow"),
        record(996, DORA_EVENT="node-ready", DORA_NODE="camera"),
    ]
    assert [one[0:1] + one[3:5] for one in read_story(records, "b", NOW)[0]] == [
        ("node-given-up", "camera", "exit code 1"),
        ("machine-lost", "", "machine gpu: no answer"),
        ("rolled-back", "sink", "slow"),
    ]


@given(
    st.lists(
        st.dictionaries(
            st.sampled_from(
                ["__MONOTONIC_TIMESTAMP", "DORA_EVENT", "DORA_UNTIL", "DORA_NODE", "DORA_REASON"]
            ),
            st.none() | st.text() | st.sampled_from(["notice-sent", "999000000", "machine-lost"]),
        )
    )
)
def test_whatever_is_in_a_record(records: list[dict[str, Any]]) -> None:
    found, _ = read_story([{"_BOOT_ID": "b", **one} for one in records], "b", NOW)
    for one in found:
        values = variables("robot", "lab", "dora-robot.service", [one], "", "/x")
        assert dict(checked_variable(*pair) for pair in values.items()) == values


def test_a_cause_of_many_lines_is_one_line() -> None:
    bad = "boom\nBcc: all@example.org\r\n\x1b[2J" + "x" * 1000
    fields = {"DORA_EVENT": "node-given-up", "DORA_NODE": "a b\n"}
    for reason in (bad, [*bad.encode()]):  # journalctl prints a text with control characters so
        record_ = {**record(999, **fields), "DORA_REASON": reason}
        (one,) = read_story([record_], "b", NOW)[0]
        assert one.node == "a"
        assert one.cause.startswith("boom Bcc: all@example.org [2Jxxx")
        assert len(one.cause) <= 500


@pytest.mark.parametrize(
    ("last", "left", "pause"),
    [
        (None, 0, FIRST_PAUSE),
        (Sent(NOW - 5 * SECOND, 0, 15 * SECOND), 10 * SECOND, 30 * SECOND),
        (Sent(NOW - 30 * SECOND, 0, 15 * SECOND), 0, 30 * SECOND),
        (Sent(NOW - 31 * SECOND, 0, 15 * SECOND), 0, FIRST_PAUSE),
        (Sent(NOW - 600 * SECOND, 0, 400 * SECOND), 0, LAST_PAUSE),
        (Sent(NOW, 0, 0), 0, FIRST_PAUSE),
        (Sent(NOW, 0, 10**18), LAST_PAUSE, LAST_PAUSE),
    ],
)
def test_pauses(last: Sent | None, left: int, pause: int) -> None:
    assert (pause_left(last, NOW), next_pause(last, NOW)) == (left, pause)


def test_a_storm_of_a_night_is_few_notices() -> None:
    """A failure every 600 ms for eight hours: five notices in no minute, and 60 in all."""
    now, last, times = 0, None, list[int]()
    while now < 8 * 3600 * SECOND:
        if not pause_left(last, now):
            last = Sent(now, now, next_pause(last, now))
            times.append(now)
        now += 600_000
    assert all(late - early > 60 * SECOND for early, late in zip(times, times[5:], strict=False))
    assert len(times) < 60


def test_the_worst_is_reported_and_all_are_counted() -> None:
    many = [
        Happened("node-given-up", 9, 90 * SECOND, "camera", "exit code 1"),
        Happened("failed", 8, 80 * SECOND, "sink", "node sink: exit code 2"),
        Happened("failed", 7, 70 * SECOND),
    ]
    assert main_one(many) == many[1]
    text = "robot on lab failed: node sink: exit code 2 (3 failures within 20s)"
    assert summary("robot", "lab", many) == text
    values = variables("robot", "lab", "dora-robot.service", many, "", "/x/why.json")
    assert values["DORA_NOTICE_COUNT"] == "3"
    assert values["DORA_NOTICE_NODE"] == "sink"
    assert values["DORA_NOTICE_SUMMARY"] == text
    assert values["DORA_NOTICE_SINCE"] == "1970-01-01T00:00:00.000007Z"
    lone = [Happened("node-given-up", 9, 9, "camera", "exit code 1")]
    assert summary("robot", "lab", lone) == "robot on lab has given up node camera: exit code 1"


def test_a_failure_before_a_rollback_is_over() -> None:
    back, failed_, new = (
        Happened("rolled-back", 8, 8, "sink", "node sink: exit code 2"),
        Happened("failed", 7, 7, "sink", "node sink: exit code 2"),
        Happened("failed", 9, 9),
    )
    assert main_one([back, failed_]) == back
    assert main_one([new, back, failed_]) == new
    text = "robot on lab has a release that was rolled back: node sink: exit code 2"
    assert summary("robot", "lab", [back]) == text


def test_environment_as_a_file() -> None:
    values = {"A": 'a "b" $c `d` \\e', "B": "", "C": "x # y ; z"}
    assert parse_environment_file(format_environment(values), "/x") == values

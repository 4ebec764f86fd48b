"""The last lines that people are shown of a node that failed."""

from collections.abc import Mapping
from typing import Any

import pytest

from dora_systemd.decisions.why.last_lines import Word, choose_last, shown_last
from dora_systemd.decisions.why.report import Report, Subject, format_report, remedies
from dora_systemd.decisions.why.verdict import Verdict

Record = Mapping[str, Any]
SLOW = "Discarding event for input `tick` due to queue size limit"
EXIT = "node_failure: dora_daemon::spawn::prepared: node exited with error: ExitCode(1)"


def said(text: str, node: str = "camera", **fields: str) -> Record:
    return {"DORA_NODE": node, "DORA_STREAM": "stdout", "PRIORITY": "6", "MESSAGE": text, **fields}


def by_library(text: str, priority: str = "4") -> Record:
    return said(text, PRIORITY=priority, DORA_TARGET="dora_node_api::event_stream")


def by_daemon(text: str, priority: str = "4") -> Record:
    return {"DORA_NODE": "daemon", "PRIORITY": priority, "MESSAGE": text}


def chosen(*records: Record, most: int = 3) -> tuple[Word, ...]:
    """records: oldest first."""
    stamped = [{"__REALTIME_TIMESTAMP": str(n), **one} for n, one in enumerate(records)]
    return choose_last(reversed(stamped), most)


def texts(*records: Record, most: int = 3) -> list[tuple[str, int]]:
    return [(one.text, one.times) for one in chosen(*records, most=most)]


def test_nodes_come_before_dora() -> None:
    noise = [by_library(f"{SLOW} {n}") for n in range(10)]
    words = [said("loading"), said("no camera")]
    assert texts(*words, *noise) == [("loading", 1), ("no camera", 1), (f"{SLOW} 9", 1)]
    assert texts(said("early"), *words, *noise) == [
        (t, 1) for t in ("early", "loading", "no camera")
    ]


def test_the_order_is_that_of_time() -> None:
    assert texts(said("a"), by_library("b"), said("c"), by_daemon("d"), most=9) == [
        (text, 1) for text in "abcd"
    ]


@pytest.mark.parametrize("error", [by_library("cannot connect", "3"), by_daemon("broken", "3")])
def test_errors_of_dora_are_words(error: Record) -> None:
    assert texts(*[said(f"line {n}") for n in range(5)], error)[-1] == (error["MESSAGE"], 1)


def test_repetitions_are_one_line() -> None:
    """Of each node, whatever the others say meanwhile; the count of the first one is whole."""
    noise = [one for _ in range(19) for one in (by_library(SLOW), said("tick", "sink"))]
    assert texts(said("start"), *noise) == [("start", 1), (SLOW, 19), ("tick", 19)]
    assert texts(*noise, said("a"), said("b"), most=3) == [("tick", 19), ("a", 1), ("b", 1)]
    times = [said(f"07:50:{n:02} slow") for n in range(30)]
    assert texts(*times) == [("07:50:29 slow", 30)]
    assert chosen(*times)[0].at_us == 29


def test_what_events_say_is_left_out() -> None:
    event = said("Node camera crashed: exit code 1", DORA_EVENT="node-crashed")
    assert texts(by_daemon(EXIT, "3"), event, {"MESSAGE": "of the dataflow"}) == []
    assert texts(said(EXIT)) == [(EXIT, 1)]


def test_not_all_of_a_flood_is_read() -> None:
    flood = [by_library(f"{SLOW} {n}") for n in range(2000)]
    assert texts(said("lost"), *flood, most=1) == [(f"{SLOW} 1999", 1)]


def test_shown() -> None:
    words = [Word(1, "a", "x"), Word(2, "a", "y", 2), Word(3, "a", "z", 19)]
    assert [one.text for one in shown_last(words, 9)] == [
        "x",
        "y",
        "y",
        "z",
        "... the same line, 19 times in all",
    ]
    assert [one.text for one in shown_last(words, 2)] == ["z", "... the same line, 19 times in all"]
    assert shown_last([], 2) == []


def test_report() -> None:
    subject = Subject("u", "robot", "dora-robot.service", "--system")
    report = Report(subject, Verdict("Failed", node="camera"), (Word(1, "camera", SLOW, 19),))
    assert "  ... the same line, 19 times in all" in format_report(report, width=80)


FULL = "OSError: [Errno 28] No space left on device"


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (FULL, "a file system that camera writes to is full: df shows which one"),
        (f"{FULL}: '/srv/a b/{{x}}'", "the file system of this file is full: df '/srv/a b/{x}'"),
        (f"{FULL}: 'a.bag'", "a file system that camera writes to is full"),
        ("tar: x: Disk quota exceeded", "a file system that camera writes to is full"),
        ('Os { code: 28, message: "No space left on device" }', "df shows which one"),
    ],
)
def test_a_full_file_system(line: str, told: str) -> None:
    subject = Subject("u", "robot", "dora-robot.service", "--system")
    report = Report(subject, Verdict("Failed", node="camera"), (Word(1, "camera", line),))
    assert told in remedies(report)[0]


@pytest.mark.parametrize("target", ["dora_node_api::x", "zenoh::y"])
def test_only_warnings_of_dora_come_last(target: str) -> None:
    """Whatever its programs or its libraries say; a node may say as much as it likes."""
    library = said("library", DORA_TARGET=target, PRIORITY="6")
    own = said("own", DORA_TARGET="my::module", PRIORITY="6")
    program = by_daemon("program", "6")
    assert texts(own, library, most=1) == [("own", 1)]
    assert texts(own, program, most=1) == [("own", 1)]
    assert texts(own, program, said("b"), most=2) == [("own", 1), ("b", 1)]
    assert texts(program, library, most=1) == [("library", 1)]

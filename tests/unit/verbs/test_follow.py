"""Following a dataflow to its end: which steps, when the last one, and what cannot be."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.decisions.logs.query import LogQuery, query_arguments
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.follow import (
    check_until_end,
    first_step,
    follow_steps,
    follow_to_end,
    is_unit_up,
    next_step,
)
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import FakeManager, options

QUERY = LogQuery(Scope(is_user=False, uid=0), name="robot", is_follow=True)


class History:
    """What happens, one item for each wait: "line", "end", "" (silence), "up" or "down"."""

    def __init__(self, *happens: str) -> None:
        self.happens: Iterator[str] = iter(happens)
        self.up = True
        self.has_ended = False
        self.shown: list[str] = []
        self.log: list[str] = ["first"]

    def wait(self, seconds: float) -> bool:
        del seconds
        for what in self.happens:
            if what in ("up", "down"):
                self.up = what == "up"
                continue
            self.has_ended = what == "end"
            self.log += [what] if what == "line" else []
            return bool(what)
        raise AssertionError("it should have ended")

    def take_end(self) -> bool:
        ended, self.has_ended = self.has_ended, False
        return ended

    def print_step(self) -> None:
        self.shown = list(self.log)

    def follow(self, end_seconds: float = 3.0) -> list[str]:
        follow_steps(self.print_step, self, lambda: self.up, end_seconds)
        assert list(self.happens) == []
        return self.shown


@pytest.fixture(autouse=True)
def short_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda _seconds: None)


def test_until_the_end() -> None:
    assert History("line", "line", "down", "end").follow() == ["first", "line", "line"]


def test_a_restart_is_no_end() -> None:
    happens = ("line", "end", "line", "", "line", "down", "end")
    assert History(*happens).follow() == ["first", "line", "line", "line"]


def test_what_does_not_run_is_printed_once() -> None:
    history = History()
    history.up = False
    assert history.follow() == ["first"]


def test_systemd_is_asked_in_silence() -> None:
    """The last lines are waited for, and the word of the end."""
    assert History("line", "down", "", "line", "end").follow() == ["first", "line", "line"]


def test_an_end_that_nobody_tells_is_an_end() -> None:
    assert History("line", "down", "").follow(0.0) == ["first", "line"]


def test_steps(tmp_path: Path) -> None:
    cursor = tmp_path / "cursor"
    option = f"--cursor-file={cursor}"

    def arguments(query: LogQuery) -> list[str]:
        return [one for one in query_arguments(query) if one[:2] == "--" != one]

    assert arguments(first_step(QUERY, cursor))[1:] == ["--quiet", "--lines=10", option]
    later = next_step(QUERY, cursor, 1_500_000)
    assert arguments(later)[1:] == ["--quiet", "--since=@1.500000", option]
    cursor.write_text("s=1")
    assert arguments(next_step(QUERY, cursor, 1_500_000))[1:] == ["--quiet", option]
    given = LogQuery(QUERY.scope, since="5m", tail="3", grep="x", is_follow=True)
    assert first_step(given, cursor).tail == "3"
    assert first_step(given, cursor).since == "5m"
    assert next_step(given, cursor, 0).grep == "x"


def test_a_step_without_records_prints_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    FakeJournal(monkeypatch, tmp_path)
    manager = FakeManager()
    manager.add(options(), "inactive")
    fake_systemd(monkeypatch, manager)
    steps: list[LogQuery] = []

    def print_query(step: LogQuery) -> int:
        steps.append(step)
        return 0

    follow_to_end(replace(QUERY, since="5m"), print_query)
    assert [query_arguments(one)[:2] for one in steps] == [["--output=short", "--quiet"]]


@pytest.mark.parametrize(("since", "status", "expected"), [("", 0, 0), ("", 1, 1), ("5m", 0, 1)])
def test_a_pattern_that_nothing_matches(
    since: str, status: int, expected: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """For --since it is known before a step is printed."""
    FakeJournal(monkeypatch, tmp_path)
    manager = FakeManager()
    manager.add(options(), "inactive")
    fake_systemd(monkeypatch, manager)
    query = replace(QUERY, since=since, grep="x", tail="all")
    assert follow_to_end(query, lambda _step: status) == expected


@pytest.mark.parametrize(
    ("query", "message"),
    [
        (replace(QUERY, name=""), "cannot wait for the end of all dataflows"),
        (replace(QUERY, others=(QUERY,)), "cannot wait for the end of several dataflows"),
        (replace(QUERY, is_reverse=True), "cannot follow with the newest lines first"),
    ],
)
def test_what_has_no_end(query: LogQuery, message: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        check_until_end(query)
    assert (caught.value.message, caught.value.code) == (message, ExitCode.USAGE)


@pytest.mark.parametrize(
    ("active", "job", "is_up"),
    [
        ("active", 0, True),
        ("activating", 0, True),
        ("deactivating", 0, True),
        ("inactive", 0, False),
        ("failed", 0, False),
        ("inactive", 7, True),
    ],
)
def test_up(active: str, job: int, is_up: bool) -> None:
    manager = FakeManager()
    manager.add(options(), active, Job=[job, "/"])
    assert is_unit_up(manager, "robot") is is_up

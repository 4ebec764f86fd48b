"""What ran is a history: what a rollback takes, and what is kept, after each course of events."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.releases.choice import Known, before, state_of, surplus
from dora_systemd.decisions.releases.past import (
    FAILED,
    INTERRUPTED,
    MOST_LINES,
    REMOVED,
    REPLACED,
    ROLLED_BACK,
    Switch,
    begins,
    completed,
    ends,
    format_switch,
    how_of,
    kept,
    marks,
    parse_history,
    runs,
)


def release(letter: str) -> str:
    return f"202611{ord(letter) - ord('A') + 1:02}T220012" if letter else ""


class Course:
    """The releases of a dataflow, by letters, and what happens to them."""

    def __init__(self, events: str = "") -> None:
        self.history: list[Switch] = []
        self.proved: dict[str, bool] = {}
        self.current = ""
        for word in events.split():
            self.take(word)

    def take(self, word: str) -> None:
        """A: deployed. x:B: B fails its trial. ^: rollback. ^A: one by name. !A: interrupted."""
        if word == "^":
            self.run(before(self.known, self.current, self.past))
        elif word.startswith("^"):
            self.run(release(word[1:]))
        elif word.startswith(("x:", "!:")):
            how = FAILED if word[0] == "x" else INTERRUPTED
            self.proved.setdefault(release(word[2:]), False)
            self.history.append(Switch(0, release(word[2:]), self.current, how, "root", "n: exit"))
        elif word.startswith("-"):
            gone = release(word[1:])
            del self.proved[gone]
            self.history.append(Switch(0, gone, self.current, REMOVED))
        else:
            self.run(release(word))

    def run(self, to: str) -> None:
        if not to:
            return
        good = [one for one, is_good in self.proved.items() if is_good]
        how = how_of(self.past, to, good)
        if to != self.current or to in marks(self.past):
            self.history.append(Switch(0, self.current, to, how, "root"))
        self.proved[to], self.current = True, to

    @property
    def past(self) -> list[Switch]:
        return completed(self.history, self.current)

    @property
    def known(self) -> list[Known]:
        return [Known(one, is_good) for one, is_good in sorted(self.proved.items())]

    @property
    def next(self) -> str:
        """The letter of the release that a rollback takes."""
        found = before(self.known, self.current, self.past)
        return next((one for one in "ABCDEFGH" if release(one) == found), "")


@pytest.mark.parametrize(
    ("events", "choice"),
    [
        ("", ""),
        ("A", ""),
        ("A B", "A"),
        ("A B ^ C", "A"),
        ("A B ^", ""),
        ("A B C ^ ^", ""),
        ("A B C ^", "A"),
        ("A B ^ x:C x:D x:E F", "A"),
        ("A B ^ C D ^", "A"),
        ("A B ^ C D", "C"),
        ("A B x:C D", "B"),
        ("A B C D ^A E", "A"),  # not C: it did not run before E
        ("A B C D ^A", ""),
        ("A B C ^ ^C", "B"),  # by name: C is good again
        ("A B C x:B", "A"),  # a rollback whose trial failed
        ("A B C !:B", "B"),  # which somebody has ended
        ("A B C -B", "A"),
        ("A B ^ ^B C", "B"),
    ],
)
def test_what_a_rollback_takes(events: str, choice: str) -> None:
    course = Course(events)
    assert course.next == choice
    if choice:
        gone = surplus(course.known, 1, course.current, (), course.past)
        assert release(choice) not in gone, "what ran well before is never removed"


@given(st.lists(st.sampled_from("ABCDEFG"), max_size=20), st.data())
def test_never_one_that_was_rolled_back_from(order: Sequence[str], data: st.DataObject) -> None:
    course = Course()
    for letter in order:
        signs = ["^", f"x:{letter}", f"!:{letter}"]
        signs += [letter] if release(letter) not in course.proved else [f"^{letter}"]
        course.take(data.draw(st.sampled_from(signs)))
        chosen = before(course.known, course.current, course.past)
        if chosen:
            assert chosen not in {*marks(course.past), course.current}
            assert chosen not in surplus(course.known, 1, course.current, (), course.past)


def test_marks_and_states() -> None:
    course = Course("A B ^ x:C !:D")
    found = marks(course.past)
    assert {one: end.how for one, end in found.items()} == {
        release("B"): ROLLED_BACK,
        release("C"): FAILED,
    }
    states = [state_of(one, course.current, "", found.get(one.id)) for one in course.known]
    assert states == ["current", "rolled-back", "failed", "unproved"]
    assert ends(course.past)[release("D")].how == INTERRUPTED
    assert release("B") in begins(course.past)
    course.take("^B")
    assert release("B") not in marks(course.past)
    assert how_of(Course("A B").past, release("C")) == REPLACED


def test_a_change_that_nobody_could_write() -> None:
    """As by a power cut after the commit: the unit file tells what runs."""
    course = Course("A B C")
    assert completed(course.history[:-1], release("C"))[-1].release == release("C")
    back = completed(course.history, release("B"))[-1]
    assert (back.former, back.how) == (release("C"), ROLLED_BACK)
    assert completed(course.history, "") == course.history
    assert completed([], release("A")) == []
    failed = Course("x:A").history
    assert runs(completed(failed, release("A"))) == [release("A")]


def test_releases_of_which_no_line_tells_ran_before() -> None:
    ids = [release(letter) for letter in "ABC"]
    assert runs([], ids) == ids
    assert runs(Course("C").history, ids) == ids
    assert before([Known(one, True) for one in ids], ids[1], Course("B").history) == ids[0]
    assert runs(Course("A B").history, ids) == ids[:2], "a power cut has ended the commit of C"


ONE = Switch(7, release("A"), release("B"), REPLACED, "root (x)", 'a "b"\n\x1b ' + "é" * 900)


def test_lines() -> None:
    line = format_switch(ONE)
    assert line.isascii()
    assert line.count(b"\n") == 1
    (found,) = parse_history(line)
    assert found._replace(reason="") == ONE._replace(reason="")
    assert found.reason.startswith('a "b"')
    assert len(found.reason) < 900


@pytest.mark.parametrize("cut", range(1, 60))
def test_an_unfinished_line_is_left_out(cut: int) -> None:
    line = format_switch(ONE._replace(reason=""))
    assert len(parse_history(line + line[:-cut])) == 1


@pytest.mark.parametrize(
    "line",
    [
        *(b"", b"{}", b"[]", b"null", b"[" * 100_000, b"\xff\x00", b'{"at_us": 1e999}'),
        format_switch(ONE._replace(former="../x")),
        format_switch(ONE._replace(how="x")),
    ],
)
def test_damaged_lines(line: bytes) -> None:
    good = format_switch(ONE)
    assert len(parse_history(good + line.strip() + b"\n" + good)) == 2


def test_a_long_history_keeps_what_it_is_for() -> None:
    course = Course("A B ^")
    gone = [Switch(n, "20251121T220012", release("A"), FAILED) for n in range(2 * MOST_LINES)]
    stay = kept([*course.history, *gone], {release("A"), release("B")})
    assert len(stay) < MOST_LINES
    assert release("B") in marks(stay)
    assert runs(stay) == [release("A")]
    assert len(kept(course.history * 1000, {release("A")})) <= MOST_LINES

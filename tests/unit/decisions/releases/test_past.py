"""What ran is a history: what a rollback takes, and what is kept, after each course of events."""

import json
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.releases.past import (
    FAILED,
    INTERRUPTED,
    MOST_LINES,
    REMOVED,
    REPLACED,
    ROLLED_BACK,
    Known,
    Switch,
    before,
    begins,
    completed,
    ends,
    format_switch,
    how_of,
    kept,
    marks,
    parse_history,
    runs,
    state_of,
    surplus,
    undone,
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


def test_the_line_of_a_switch() -> None:
    one = Switch(7, release("A"), "", FAILED, "root (x)", "a\n b", "camera", "ff")
    assert format_switch(one) == (
        b'{"at_us": 7, "from": "20261101T220012", "to": "", "ended": "failed", '
        b'"by": "root (x)", "reason": "a b", "node": "camera", "invocation": "ff"}\n'
    )
    assert parse_history(format_switch(one)) == [one._replace(reason="a b")]


@pytest.mark.parametrize("name", ["by", "reason", "node"])
@pytest.mark.parametrize(("text", "kept_text"), [("x" * 801, "x" * 800), ("é" * 401, "é" * 400)])
def test_long_texts_are_cut(name: str, text: str, kept_text: str) -> None:
    line = format_switch(Switch(1, "", release("A"), REPLACED, **{name: text}))
    (found,) = parse_history(line)
    assert getattr(found, name) == kept_text


@pytest.mark.parametrize("how", [REPLACED, ROLLED_BACK, FAILED, INTERRUPTED, REMOVED])
def test_which_changes_are_commits(how: str) -> None:
    one = ONE._replace(how=how)
    assert one.is_commit is (how in (REPLACED, ROLLED_BACK))
    assert not one._replace(release="").is_commit
    assert parse_history(format_switch(one))[0].how == how


@pytest.mark.parametrize("key", ["at_us", "from", "to", "ended", "by", "reason"])
def test_a_line_without_one_of_its_keys(key: str) -> None:
    value = json.loads(format_switch(ONE))
    del value[key]
    assert parse_history(json.dumps(value).encode() + b"\n") == []


@pytest.mark.parametrize(
    ("events", "how"),
    [
        ("", ""),
        ("A", ""),
        ("A B", ""),
        ("A B ^", ROLLED_BACK),
        ("A x:B", FAILED),
        ("A !:B", INTERRUPTED),
        ("A B ^ -B", ROLLED_BACK),
        ("A x:B C", ""),
    ],
)
def test_what_was_undone_last(events: str, how: str) -> None:
    last = undone(Course(events).history)
    assert (last.how if last else "") == how


def test_when_a_release_began_and_ended() -> None:
    past = [
        *(Switch(1, "", release("A"), REPLACED), Switch(2, release("A"), release("B"), REPLACED)),
        *(Switch(3, release("C"), release("B"), FAILED), Switch(4, release("B"), "", REMOVED)),
        Switch(5, release("B"), release("A"), ROLLED_BACK),
        Switch(6, release("A"), release("A"), REPLACED),
    ]
    assert begins(past) == {release("A"): 5, release("B"): 3}
    assert {one: end.at_us for one, end in ends(past).items()} == {
        **{release("A"): 6, release("C"): 3, release("B"): 5}
    }


def test_the_missing_change_has_the_time_that_is_known() -> None:
    past = Course("A B").history
    assert completed(past, release("C"), 9)[-1] == Switch(9, release("B"), release("C"), REPLACED)
    assert completed(past, release("C"))[-1].at_us == 0
    removed = [*past, Switch(5, release("A"), release("B"), REMOVED)]
    assert completed(removed, release("B")) == removed
    assert how_of(past, release("B")) == REPLACED
    assert how_of(past, release("A")) == ROLLED_BACK


def test_the_newest_half_is_kept() -> None:
    past = [Switch(n, release("A"), release("B"), FAILED) for n in range(MOST_LINES)]
    stay = kept(past, [release("A")])
    assert [one.at_us for one in stay] == [*range(MOST_LINES // 2, MOST_LINES)]
    assert kept(past, [release("B")]) == []
    runs_ = [one._replace(how=REPLACED) for one in past]
    assert len(kept(runs_, [])) == MOST_LINES // 2

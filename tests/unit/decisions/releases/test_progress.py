"""The words of a deploy's progress, and which of them are shown."""

import pytest

from dora_systemd.decisions.releases.progress import (
    STAGES,
    Pace,
    Step,
    building,
    checking,
    copied,
    copying,
    going_back,
    judged,
    soaking,
    starting,
    stopping,
    waiting,
)
from dora_systemd.decisions.views.releases import step_object
from dora_systemd.values import SECOND

RUNNING = "3/3 nodes running"
WORDS = {
    "copying: 12M of 500M": copying(12 << 20, 500 << 20),
    "copied: 1 file, 4.1M, 12K of it new": copied(1, 4_300_000, 12 << 10),
    "copied: 37 files, 0B, 0B of it new": copied(37, 0, 0),
    "checking": checking(),
    "building": building(""),
    "building: Compiling arrow v53.0": building("Compiling arrow v53.0"),
    "x inhibits it": waiting("x inhibits it"),
    "stopping what runs now": stopping(RUNNING),
    "stopping what runs now: a, b left": stopping("stopping, a, b left"),
    "trial: starting": starting(""),
    "trial: 1/3 nodes ready, waiting for b": starting("1/3 nodes ready, waiting for b"),
    "trial: 3/3 nodes ready, soak 12/30 s": soaking(RUNNING, 12_900_000, 30 * SECOND),
    "trial: 3/3 nodes ready, soak 0/0.5 s": soaking(RUNNING, 400_000, SECOND // 2),
    "trial: 3/3 nodes ready, soak 30/30 s": soaking(RUNNING, 31 * SECOND, 30 * SECOND),
    "trial: 3/3 nodes ready, soak 1min 5s of 1h": soaking(RUNNING, 65 * SECOND, 3600 * SECOND),
    "trial: 3/3 nodes ready": soaking(RUNNING, 5, 0),
    "trial: 2/3 nodes ready; finished: a": soaking("2/3 nodes running; finished: a", 5, 0),
    "trial: up, soak 1/2 s": soaking("", SECOND, 2 * SECOND),
    "trial of X: passed": judged("X", ""),
    "trial of X: failed: node a: exit code 1": judged("X", "node a: exit code 1"),
    "going back to W": going_back("W", ""),
    "going back to what ran before: starting": going_back("", "starting"),
}


@pytest.mark.parametrize("text", WORDS)
def test_words(text: str) -> None:
    step = WORDS[text]
    assert step.text == text
    assert len(text) < 60, "what counts is not cut off on a narrow terminal"


def test_every_stage_has_words() -> None:
    assert {step.stage for step in WORDS.values()} == {*STAGES}


def shown(pace: Pace, *steps: tuple[float, Step]) -> list[str]:
    return [step.text for now, step in steps if pace.takes(step, now)]


def test_what_grows_is_shown_now_and_then() -> None:
    steps = [(second, soaking(RUNNING, second * SECOND, 30 * SECOND)) for second in range(31)]
    assert [text.split()[-2] for text in shown(Pace(10), *steps)] == [
        *("0/30", "10/30", "20/30", "30/30")
    ]
    copy = [(at / 10, copying(at, 100)) for at in range(101)]
    assert shown(Pace(60), *copy, (10.1, copied(2, 100, 5))) == [
        "copying: 0B of 100B",
        "copied: 2 files, 100B, 5B of it new",
    ]


def test_news_is_shown_at_once_and_nothing_twice() -> None:
    one, two = starting("1/2 nodes ready"), starting("2/2 nodes ready")
    assert shown(Pace(10), (0, one), (0, one), (0.1, two), (99, two), (99, judged("X", ""))) == [
        *("trial: 1/2 nodes ready", "trial: 2/2 nodes ready", "trial of X: passed")
    ]


def test_numbers_for_programs() -> None:
    assert step_object(copying(12, 500)) == {
        "stage": "copy",
        "text": "copying: 12B of 500B",
        "done_bytes": 12,
        "total_bytes": 500,
        **dict.fromkeys(("nodes_ready", "nodes_total", "soaked_us", "soak_us", "passed")),
    }
    soak = step_object(soaking("2/3 nodes running", 7, 9))
    assert [soak[key] for key in ("nodes_ready", "nodes_total", "soaked_us", "soak_us")] == [
        *(2, 3, 7, 9)
    ]
    assert step_object(judged("X", "y"))["passed"] is False
    assert all(step_object(step).keys() == soak.keys() for step in WORDS.values())


@pytest.mark.parametrize("status", ["", "x 1/2 nodes ready", "9999999/1 nodes ready", "1/2 nodes"])
def test_a_text_without_numbers(status: str) -> None:
    assert starting(status).nodes is None


def test_a_sign_of_life() -> None:
    """Who waits for hours says so now and then, if that is asked for."""
    one = waiting("it drives")
    steps = [(0.0, one), (29.0, one), (30.0, one), (59.0, one), (61.0, one)]
    assert len(shown(Pace(1, 30), *steps)) == 3
    assert len(shown(Pace(1), *steps)) == 1


FACTS = {
    waiting("x"): ("wait", None, None, None, False),
    copying(5, 9): ("copy", (5, 9), None, None, False),
    copied(2, 9, 5): ("copy", (9, 9), None, None, True),
    checking(): ("check", None, None, None, False),
    building("x"): ("build", None, None, None, False),
    stopping("stopping, a left"): ("stop", None, None, None, False),
    starting("1/3 nodes ready"): ("start", None, (1, 3), None, False),
    soaking("3/3 nodes running", 5, 9): ("soak", (5, 9), (3, 3), None, False),
    soaking("3/3 nodes running", 9, 9): ("soak", (9, 9), (3, 3), None, True),
    soaking("", 10, 9): ("soak", (9, 9), None, None, True),
    soaking("", 9, 9, "camera/image"): ("soak", (9, 9), None, None, False),
    judged("X", ""): ("verdict", None, None, True, False),
    judged("X", "y"): ("verdict", None, None, False, False),
    going_back("X", "2/3 nodes ready"): ("back", None, (2, 3), None, False),
}


@pytest.mark.parametrize(("step", "facts"), FACTS.items())
def test_what_programs_are_told(step: Step, facts: tuple[object, ...]) -> None:
    assert (step.stage, *step[2:]) == facts


def test_what_the_verdict_waits_for() -> None:
    step = soaking("1/1 nodes running; 1 nodes running", SECOND, 2 * SECOND, "camera/image")
    words = "trial: 1/1 nodes ready; 1 nodes running, soak 1/2 s, waits for camera/image"
    assert step.text == words


@pytest.mark.parametrize(
    ("soak", "words"),
    [(600 * SECOND, "61/600 s"), (601 * SECOND, "1min 1s of 10min 1s")],
)
def test_a_long_soak(soak: int, words: str) -> None:
    assert soaking("", 61_900_000, soak).text == f"trial: up, soak {words}"


def test_when_what_grows_is_shown() -> None:
    pace = Pace(10, 30)
    at = [0.0, 9.9, 10.0, 19.9, 20.0]
    steps = [soaking("", number, 99 * SECOND) for number in range(5)]
    steps = [one._replace(text=f"{number}") for number, one in enumerate(steps)]
    shown_ones = [pace.takes(step, now) for step, now in zip(steps, at, strict=True)]
    assert shown_ones == [True, False, True, False, True]
    assert not pace.takes(steps[-1], 49.9), "the same text is no news"
    assert pace.takes(steps[-1], 50.0)
    assert pace.takes(steps[-1]._replace(text="x", nodes=(1, 2)), 50.0)
    assert pace.takes(steps[-1]._replace(text="y", nodes=(1, 2), is_last=True), 50.0)

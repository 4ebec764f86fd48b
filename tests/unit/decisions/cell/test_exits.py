"""How a process ended: each text becomes a value, and the same text again."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.exits import EARLY, Exit, ExitKind, exit_of, find_exit, parse_exit

TEXTS = {
    "": Exit(),
    "exit code 3": Exit(ExitKind.CODE, 3),
    "exit code -1": Exit(ExitKind.CODE, -1),
    "exit code 0 before it called dora": EARLY,
    "signal SIGKILL": Exit(ExitKind.SIGNAL, 9),
    "signal 35": Exit(ExitKind.SIGNAL, 35),
    "signal SIGKILL after the grace duration": Exit(
        ExitKind.SIGNAL, 9, " after the grace duration"
    ),
    "signal SIGTERM because node a failed": Exit(ExitKind.SIGNAL, 15, by="a"),
    "unknown exit status": Exit(words="unknown exit status"),
    "unknown exit status because node a failed": Exit(words="unknown exit status", by="a"),
    "node a failed before the start": Exit(by="a"),
    "hung, unresponsive for 5322ms": Exit(ExitKind.HUNG, words="unresponsive for 5322ms"),
    "out of memory, peak 1M, limit 1M": Exit(words="out of memory, peak 1M, limit 1M"),
    "failed to spawn: x": Exit(words="failed to spawn: x"),
    "signal SIGNONE": Exit(words="signal SIGNONE"),
    "exit code SIGKILL": Exit(words="exit code SIGKILL"),
    "signal 9": Exit(words="signal 9"),
    "exit code 05": Exit(ExitKind.CODE, 0, "5"),
    "exit code 1 because node a failed because node b failed": Exit(
        ExitKind.CODE, 1, " because node a failed", "b"
    ),
    "node failed before the start": Exit(words="node failed before the start"),
    " because node a failed": Exit(words=" because node a failed"),
    "an end of a later version": Exit(words="an end of a later version"),
}


@pytest.mark.parametrize(("text", "exit"), TEXTS.items())
def test_text_and_value(text: str, exit: Exit) -> None:
    assert (parse_exit(text), str(exit)) == (exit, text)
    assert exit.is_failure == bool(text)
    assert exit.details() == ({"exit": text} if text else {})


@given(st.text() | st.lists(st.sampled_from([*TEXTS, " because node ", " failed"])).map("".join))
def test_any_text_stays_what_it_is(text: str) -> None:
    assert str(parse_exit(text)) == text.replace("exit code -0", "exit code 0")


def test_a_text_that_repeats_itself_is_no_work() -> None:
    text = "x" + " because node a failed" * 10_000
    assert parse_exit(text).by == "a"


def test_children() -> None:
    assert [str(exit_of(one)) for one in (0, 3, -9, -200)] == [
        *("exit code 0", "exit code 3", "signal SIGKILL", "signal 200"),
    ]


def test_find() -> None:
    assert find_exit("node a: exit code 3 after 2 restarts").number == 3
    assert find_exit("node a: signal SIGKILL\nexit code 1")[:2] == (ExitKind.SIGNAL, 9)
    assert find_exit("start: exit code 217/USER").number == 217
    assert not find_exit("it was stopped").is_failure

"""Progress on a terminal, in a pipe and for programs."""

import io
import json
from itertools import count

import pytest

from dora_systemd.cli.progress import Progress
from dora_systemd.decisions.releases.progress import Step, checking, copied, copying, judged
from tests.unit.cli.test_terminal import Terminal

STEPS = (copying(1, 3), copying(2, 3), copied(1, 3, 0), checking(), checking(), judged("X", ""))


def show(stream: io.StringIO, *steps: Step, **how: bool) -> None:
    with Progress(stream, clock=count(1.0).__next__, **how) as progress:
        for step in steps:
            progress(step)


def test_a_pipe_gets_lines_that_are_news() -> None:
    stream = io.StringIO()
    show(stream, *STEPS)
    assert stream.getvalue() == (
        "copying: 1B of 3B\ncopied: 1 file, 3B, 0B of it new\nchecking\ntrial of X: passed\n"
    )


def test_a_terminal_has_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    show(stream, *STEPS[:2])
    back = "\r\x1b[K"
    assert stream.getvalue() == f"{back}copying: 1B of 3B{back}copying: 2B of 3B{back}"
    monkeypatch.setenv("TERM", "dumb")
    dumb = Terminal()
    show(dumb, *STEPS[:2])
    assert dumb.getvalue() == "copying: 1B of 3B\n"


def test_texts_of_others_stay_in_their_line() -> None:
    stream = io.StringIO()
    show(stream, checking()._replace(text="a\nb\r\x1b[2Jc"))
    assert stream.getvalue().count("\n") == 1
    assert not {"\r", "\x1b"} & {*stream.getvalue()}


def test_programs_get_an_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    show(io.StringIO(), *STEPS, is_json=True)
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [one["progress"]["stage"] for one in lines] == ["copy"] * 3 + ["check", "verdict"]
    assert {one["schema"] for one in lines} == {1}


@pytest.mark.parametrize("is_json", [True, False])
def test_quiet(capsys: pytest.CaptureFixture[str], is_json: bool) -> None:
    stream = Terminal()
    with Progress(stream, is_json=is_json, is_quiet=True) as progress:
        progress(checking())
        progress.warn("x")
    assert not stream.getvalue()
    assert capsys.readouterr() == ("", "")

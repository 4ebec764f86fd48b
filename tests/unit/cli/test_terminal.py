"""Colours, and the status line."""

import io

import pytest

from dora_systemd.cli.terminal import StageLine, is_dumb, wants_colors


class Stream(io.StringIO):
    """A stream that may be a terminal."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


@pytest.mark.parametrize(
    ("environ", "on_terminal", "in_pipe"),
    [
        ({"TERM": "xterm"}, True, False),
        ({}, False, False),
        ({"TERM": "dumb"}, False, False),
        ({"TERM": "xterm", "NO_COLOR": "1"}, False, False),
        ({"TERM": "xterm", "NO_COLOR": ""}, True, False),
        ({"TERM": "xterm", "SYSTEMD_COLORS": "0"}, False, False),
        ({"TERM": "xterm", "SYSTEMD_COLORS": "no"}, False, False),
        ({"SYSTEMD_COLORS": "yes", "NO_COLOR": "1"}, True, True),
        ({"SYSTEMD_COLORS": "256"}, True, True),
        ({"TERM": "xterm", "SYSTEMD_COLORS": "auto-16"}, True, False),
        ({"TERM": "xterm", "SYSTEMD_COLORS": "blue"}, True, False),
    ],
)
def test_colors(environ: dict[str, str], on_terminal: bool, in_pipe: bool) -> None:
    assert wants_colors(Stream(True), environ) is on_terminal
    assert wants_colors(Stream(False), environ) is in_pipe


def test_a_dumb_terminal() -> None:
    assert [is_dumb({"TERM": term}) for term in ("dumb", "", "xterm")] == [True, True, False]
    assert is_dumb({})


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_stage_is_written_once_and_erased_at_the_end() -> None:
    stream = Terminal()
    with StageLine(stream) as stage:
        stage("starting")
        stage("starting")
        stage("started")
    assert stream.getvalue() == "\r\x1b[Kstarting\r\x1b[Kstarted\r\x1b[K"


def test_room_for_other_output() -> None:
    stream = Terminal()
    with StageLine(stream) as stage:
        stage("starting")
        stage.wipe()
        stream.write("warning\n")
        stage("starting")
    assert stream.getvalue() == "\r\x1b[Kstarting\r\x1b[Kwarning\n\r\x1b[Kstarting\r\x1b[K"


def test_nothing_to_a_pipe() -> None:
    stream = io.StringIO()
    with StageLine(stream) as stage:
        stage("starting")
    assert not stream.getvalue()


def test_a_pipe_hears_once_which_machine_is_away() -> None:
    stream = io.StringIO()
    away = "waiting for machines gpu (it is not connected yet), pi (connection refused)"
    with StageLine(stream) as stage:
        stage("waiting for machine gpu (it is not connected yet)")
        stage(away)
        stage(away)
    assert stream.getvalue() == f"{away}\n"


def test_a_stop_waits_for_no_machine() -> None:
    """The first status of a dataflow that is stopped while it waits is that wait."""
    stream = io.StringIO()
    with StageLine(stream, is_stop=True) as stage:
        stage("waiting for machine gpu (connection refused)")
    assert not stream.getvalue()

"""When doractl writes colours, by the rules of systemd(1)."""

import io

import pytest

from dora_systemd.cli.colors import is_dumb, wants_colors


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

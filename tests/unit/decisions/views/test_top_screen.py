"""What `doractl top` shows on a terminal of any size, and what its keys do."""

import pytest

from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.top import NOTHING, Look, TopEntry
from dora_systemd.decisions.views.top_screen import HELP, TopScreen

NODES = (
    NodeRow("camera", "running", 7, 12.0, 200 << 20, since=1),
    NodeRow("detector", "failed", exit="exit code 1"),
    NodeRow("plot\n\x1b[2J", "running", 9, 1.0, 90 << 20, since=1),
)
ROBOT = TopEntry(
    DataflowRow("u1", "robot", "dora-robot.service", "Degraded", cpu_percent=50.0, nodes=NODES)
)
ARM = TopEntry(DataflowRow("u2", "arm-" + "x" * 90, "dora-arm.service", "Running", cpu_percent=9.0))


def screen_of(*entries: TopEntry) -> TopScreen:
    screen = TopScreen("cpu")
    screen.see(Look(1_000_000, entries))
    return screen


def texts(screen: TopScreen, columns: int = 80, height: int = 24) -> list[str]:
    return [line.text.rstrip() for line in screen.lines(columns, height)]


def press(screen: TopScreen, *keys: str) -> None:
    for key in keys:
        assert screen.press(key) is None


def selected(screen: TopScreen, height: int = 24) -> str:
    (line,) = [line for line in screen.lines(80, height) if "reverse" in line.style]
    return line.text.split()[0]


@pytest.mark.parametrize("columns", [1, 20, 60, 61, 80, 132, 300])
@pytest.mark.parametrize("height", [1, 2, 3, 4, 5, 8, 50])
def test_any_size(columns: int, height: int) -> None:
    screen = screen_of(ROBOT, ARM)
    for key in ("", "KEY_DOWN", "KEY_NPAGE", "KEY_HOME", "KEY_END", "R", "n", "?"):
        press(screen, key)
        lines = screen.lines(columns, height)
        assert len(lines) == height
        assert max(len(line.text) for line in lines) <= columns
        assert not any("\n" in line.text or "\x1b" in line.text for line in lines)
        if height > 1 and key != "?":
            assert sum("reverse" in line.style for line in lines) == 1


def test_a_low_terminal_keeps_rows_and_the_last_line() -> None:
    screen = screen_of(ROBOT)
    assert [line.split()[0] for line in texts(screen, height=3)] == ["NAME", "robot", "1-1/4"]
    assert [line.split()[0] for line in texts(screen, height=2)] == ["robot", "1-1/4"]
    assert [line.split()[0] for line in texts(screen, height=1)] == ["1-1/4"]


def test_it_scrolls_with_the_selected_row() -> None:
    screen = screen_of(ROBOT, ARM)
    height = 5
    assert selected(screen, height) == "robot"
    names = []
    for key in ("KEY_DOWN", "KEY_NPAGE", "KEY_NPAGE", "KEY_UP", "KEY_PPAGE", "KEY_HOME", "KEY_END"):
        press(screen, key)
        names.append(selected(screen, height)[:6])
    assert names == ["camera", "detect", "arm-xx", "detect", "camera", "robot", "arm-xx"]
    assert texts(screen, height=height)[-1].startswith("4-5/5  ")


def test_a_question_is_one_on_a_narrow_terminal() -> None:
    screen = screen_of(ARM)
    press(screen, "S")
    assert texts(screen, columns=60)[-1] == f"Stop arm-{'x' * 45}…? y/n"
    assert texts(screen, columns=200)[-1] == f"Stop arm-{'x' * 90}? y/n"


def test_nothing_runs() -> None:
    screen = screen_of()
    assert NOTHING in texts(screen)
    press(screen, "KEY_DOWN", "KEY_END", "R", "y")
    assert NOTHING in texts(screen)


def test_colours_by_state() -> None:
    screen = screen_of(ROBOT, ARM)
    found = {line.text.split()[0]: line.style for line in screen.lines(80, 8)[2:7]}
    assert found.pop("detector") == "red"
    assert found.pop("robot") == "yellow reverse"
    assert set(found.values()) == {""}


def test_order() -> None:
    screen = screen_of(ROBOT, ARM)

    def names() -> list[str]:
        return [line.split()[0][:6] for line in texts(screen, height=8)[2:7]]

    assert names() == ["robot", "camera", "plot", "detect", "arm-xx"]
    press(screen, "n")
    assert names() == ["arm-xx", "robot", "camera", "detect", "plot"]
    press(screen, "r")
    assert names() == ["robot", "plot", "detect", "camera", "arm-xx"]
    press(screen, "r", "m")
    assert names() == ["arm-xx", "robot", "camera", "plot", "detect"]


def test_a_selected_row_stays_selected_wherever_it_goes() -> None:
    screen = screen_of(ROBOT, ARM)
    press(screen, "KEY_DOWN")
    screen.see(Look(2_000_000, (ARM, ROBOT)))
    press(screen, "n")
    assert selected(screen) == "camera"
    screen.see(Look(3_000_000, (ARM,)))
    assert selected(screen)[:6] == "arm-xx"


def test_without_a_choice_the_first_row_is_selected() -> None:
    screen = screen_of(ROBOT, ARM)
    press(screen, "n")
    assert selected(screen)[:6] == "arm-xx"


@pytest.mark.parametrize(
    ("keys", "question", "change"),
    [
        (["R"], "Restart robot? y/n", ("restart", "")),
        (["S"], "Stop robot? y/n", ("stop", "")),
        (["KEY_DOWN", "R"], "Restart node camera of robot? y/n", ("restart", "camera")),
        (["KEY_DOWN", "S"], "Stop node camera of robot? y/n", ("stop", "camera")),
    ],
)
def test_changes_ask_first(keys: list[str], question: str, change: tuple[str, str]) -> None:
    screen = screen_of(ROBOT)
    press(screen, *keys)
    assert texts(screen)[-1] == question
    press(screen, "", "n")
    assert texts(screen)[-1] != question
    press(screen, keys[-1])
    screen.see(Look(2_000_000, (ARM,)))
    wanted = screen.press("y")
    assert wanted
    assert (wanted.action, wanted.row.uuid, wanted.row.node) == (change[0], "u1", change[1])
    press(screen, "y")


def test_what_was_said_stays_until_a_key() -> None:
    screen = screen_of(ROBOT)
    screen.said = "cannot restart robot: reason"
    press(screen, "")
    assert texts(screen)[-1] == "cannot restart robot: reason"
    press(screen, "KEY_UP")
    assert texts(screen)[-1].startswith("q quit")


def test_help_covers_the_rows_until_any_key() -> None:
    screen = screen_of(ROBOT)
    press(screen, "?")
    shown = texts(screen)
    assert set(HELP.strip().splitlines()) <= set(shown)
    assert shown[-1] == "Any key goes back."
    press(screen, "q")
    assert not screen.is_over
    assert "robot" in texts(screen)[2]
    press(screen, "q")
    assert screen.is_over

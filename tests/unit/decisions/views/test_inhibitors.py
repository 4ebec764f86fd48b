"""What people and programs are told of locks, whatever a process is called."""

import pytest

from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.inhibitors import (
    Inhibited,
    format_holder,
    format_holders,
    format_inhibited,
    format_reason,
    inhibited_objects,
    parse_reason,
    parse_reasons,
)
from dora_systemd.decisions.views.rows import DataflowRow, Holder
from dora_systemd.errors import DoraSystemdError, ExitCode

NODE = Holder(231, "dora", "/srv/robot/.venv/bin/python -u /srv/robot/arm.py", "arm", "it moves")
SHELL = Holder(77, "alice", "/usr/bin/python3 /usr/bin/doractl inhibit robot", "", "mission")
ROBOT = Inhibited("robot", "44f30e60", "dora-robot.service", (NODE, SHELL))


@pytest.mark.parametrize(
    ("holder", "text"),
    [
        (NODE, "node arm (PID 231, user dora, python -u arm.py): it moves"),
        (SHELL, "python3 doractl inhibit robot (PID 77, user alice): mission"),
        (Holder(0), "an unknown process"),
        (Holder(9), "an unknown process (PID 9)"),
        (Holder(9, "a", "x\n\x1b[2Jy"), "x \\x1b[2Jy (PID 9, user a)"),
    ],
)
def test_a_holder_in_a_line(holder: Holder, text: str) -> None:
    assert format_holder(holder) == text


def test_more_holders_than_one() -> None:
    assert format_holders([SHELL]) == format_holder(SHELL)
    assert format_holders([SHELL, NODE, NODE]) == f"{format_holder(SHELL)}; and 2 more"


def test_the_table() -> None:
    table = format_inhibited([ROBOT], None, want_colors=False)
    assert table.splitlines() == [
        "NAME   NODE  PID  USER   COMMAND                        WHY",
        "robot  arm   231  dora   python -u arm.py               it moves",
        "robot  -      77  alice  python3 doractl inhibit robot  mission",
    ]
    for width in (60, 50):
        narrow = format_inhibited([ROBOT], width, want_colors=False)
        assert all(len(line) <= width for line in narrow.splitlines())


def test_objects_are_flat() -> None:
    first, second = inhibited_objects([ROBOT])
    assert (first["name"], first["node"], first["why"]) == ("robot", "arm", "it moves")
    assert second["node"] is None


def test_a_dataflow_shows_who_inhibits_it() -> None:
    row = DataflowRow("u", "robot", "dora-robot.service", "Running", inhibitors=(NODE,))
    assert f"\nInhibit:  {format_holder(NODE)}" in format_dataflow(row)
    assert "Inhibit" not in format_dataflow(row._replace(inhibitors=()))


def test_reasons() -> None:
    assert parse_reasons(format_reason(5, "a b") + format_reason(6, "c") + b"5 d\n7\n") == {
        5: "d",
        6: "c",
        7: "",
    }
    assert parse_reason(" it\nis\tdriving ") == "it is driving"
    assert len(parse_reason("x" * 999)) == 200
    for text in ("", " \n"):
        with pytest.raises(DoraSystemdError) as caught:
            parse_reason(text)
        assert caught.value.code is ExitCode.USAGE

"""After the power cut: it was one, the dataflows are back, and so are their lines from before."""

from tests.boot.test_after import they_are_back
from tests.system.cells import run


def test_it_was_a_power_cut() -> None:
    said = run("journalctl", "--boot=-1", "--output=cat", "_PID=1").stdout
    assert said
    assert "Reached target reboot.target" not in said


def test_they_are_back_again() -> None:
    they_are_back()


def test_lines_from_before_are_there() -> None:
    started = ("journalctl", "--boot=-1", "--output=cat", "DORA_EVENT=dataflow-started")
    assert run(*started).stdout

"""After the power cut: it was one, the dataflows are back, and so are their lines from before."""

import json

from tests.boot.flows import doractl
from tests.boot.test_after import they_are_back
from tests.system.cells import run, wait_for

UNITS = ("--unit=doranotice@begun", "--unit=dora-begun")


def test_it_was_a_power_cut() -> None:
    """After a shutdown the file system has nothing to recover."""
    said = run("journalctl", "--boot", "--dmesg", "--output=cat").stdout
    assert "EXT4-fs" in said
    assert "recovery complete" in said


def test_they_are_back_again() -> None:
    they_are_back()


def test_the_one_with_a_black_box_has_a_bundle() -> None:
    """Written without anyone logged in; of the others there is none."""

    def rows() -> list[dict[str, str]]:
        found: list[dict[str, str]] = json.loads(doractl("bundles", "-o", "json"))
        return found

    try:
        (row,) = wait_for("the bundle", rows, 240)
    except AssertionError:
        print(run("journalctl", "--output=short-precise", *UNITS).stdout)
        raise
    assert (row["name"], row["event"], row["by"]) == ("begun", "power-lost", "doranotice")
    words = "the machine went down while it ran, without a shutdown"
    assert words in doractl("why", "--bundle", row["file"])
    assert row["file"] in doractl("why", "begun")


def test_lines_from_before_are_there() -> None:
    started = ("journalctl", "--boot=-1", "--output=cat", "DORA_EVENT=dataflow-started")
    assert run(*started).stdout

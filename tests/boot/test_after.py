"""After the reboot: they are back, with their UUIDs; one without its file has failed alone."""

import json
from functools import partial
from typing import Any

from dora_systemd.bus import Bus
from dora_systemd.scope import scope_of
from tests.boot.flows import ALICE, NOTES, ROOT, listed
from tests.system.cells import run, wait_for


def status(caller: tuple[str, ...], name: str) -> str:
    return str(listed(caller)[name]["status"])


def is_running(caller: tuple[str, ...], name: str) -> bool:
    return status(caller, name) == "Running"


def they_are_back() -> None:
    """Those that were enabled run, with their UUIDs and settings."""
    notes = json.loads(NOTES.read_text())
    active = ("is-active", "multi-user.target")
    wait_for("the boot", lambda: not run("systemctl", *active, check=False).returncode, 240)
    for caller, name in ((ROOT, "begun"), (ROOT, "running"), (ALICE, "mine")):
        wait_for(name, partial(is_running, caller, name), 240)
        assert listed(caller)[name]["uuid"] == notes[name]
    found = Bus(scope_of(None)).read("dora-begun.service", ["Environment"])["Environment"]
    assert "A=x $B %h" in found


def test_they_are_back() -> None:
    they_are_back()


def test_the_boot_waits_for_none_of_them() -> None:
    """One that never gets ready starts for ever, on a machine that is up."""
    wait_for("its start", lambda: status(ROOT, "never") == "Starting", 240)
    jobs = run("systemctl", "list-jobs", "--no-legend").stdout.splitlines()
    waiting = [line.split()[1] for line in jobs]
    assert "dora-never.service" in waiting
    assert not [unit for unit in waiting if unit.endswith(".target")]


def test_one_without_its_file_has_failed() -> None:
    """The boot has gone on, and the status says which file."""
    wait_for("its failure", lambda: status(ROOT, "gone") == "Failed", 240)
    row = listed(ROOT)["gone"]
    assert "/srv/gone/dataflow.yml" in row["text"]
    shown = run("systemctl", "is-active", "multi-user.target", "dora.target").stdout.split()
    assert shown == ["active", "active"]


def why(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run("doractl", "why", name, "-o", "json").stdout)
    return found


def test_what_was_before_the_reboot_is_explained() -> None:
    """systemd knows neither of them any more, the journal does."""
    assert not listed(ROOT).keys() & {"broken", "passing"}
    broken = why("broken")
    assert (broken["status"], broken["cause"]) == ("Failed", "node-failed")
    assert broken["summary"] == "node only: exit code 3"
    assert [one["text"] for one in broken["last_lines"]] == ["no camera there"]
    passing = why("passing")
    assert (passing["status"], passing["is_failure"]) == ("Stopped", False)
    assert passing["stopped_by"] == "the shutdown of the machine"

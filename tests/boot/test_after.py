"""After the reboot: they are back, with their UUIDs; one without its file has failed alone."""

import json
from functools import partial
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.scope import scope_of
from tests.boot.flows import AFTER, ALICE, NOTES, ROOT, check_typed, doractl, listed
from tests.system.cells import run, wait_for

# Asked often, and much faster than doractl in a machine of the lab.
HERS = ("--user", "--machine=alice@")


def is_state(name: str, state: str, *manager: str) -> bool:
    """Whether systemd says so of a dataflow."""
    return run("systemctl", *manager, "is-active", f"dora-{name}", check=False).stdout == state


def they_are_back() -> None:
    """Those that were enabled run, with their UUIDs and settings."""
    notes = json.loads(NOTES.read_text())
    active = ("is-active", "multi-user.target")
    wait_for("the boot", lambda: not run("systemctl", *active, check=False).returncode, 240)
    for caller, manager, names in ((ROOT, (), ("begun", "running")), (ALICE, HERS, ("mine",))):
        for name in names:
            wait_for(name, partial(is_state, name, "active\n", *manager), 240)
        rows = listed(caller)
        found = {name: (rows[name]["status"], rows[name]["uuid"]) for name in names}
        assert found == {name: ("Running", notes[name]) for name in names}
    unit = Bus(scope_of(None)).read("dora-begun.service", ["Environment", "ExecStart"])
    assert "A=x $B %h" in unit["Environment"]
    assert {"/usr/bin/python3", "--dora=/usr/bin/dora"} <= set(unit["ExecStart"][0][1])


def test_they_are_back() -> None:
    they_are_back()
    assert json.loads(doractl("bundles", "begun", "-o", "json")) == [], "it was shut down"


def test_the_boot_waits_for_none_of_them() -> None:
    """One that never gets ready starts for ever, on a machine that is up."""
    wait_for("its start", lambda: is_state("never", "activating\n"), 240)
    jobs = run("systemctl", "list-jobs", "--no-legend").stdout.splitlines()
    waiting = [line.split()[1] for line in jobs]
    assert "dora-never.service" in waiting
    assert not [unit for unit in waiting if unit.endswith(".target")]


def test_one_without_its_file_has_failed() -> None:
    """The boot has gone on, and the status says which file."""
    wait_for("its failure", lambda: is_state("gone", "failed\n"), 240)
    row = listed(ROOT)["gone"]
    assert row["status"] == "Failed"
    assert "/srv/gone/dataflow.yml" in row["text"]
    shown = run("systemctl", "is-active", "multi-user.target", "dora.target").stdout.split()
    assert shown == ["active", "active"]


def why(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(doractl("why", name, "-o", "json"))
    return found


def test_what_was_before_the_reboot_is_explained() -> None:
    """systemd knows neither of them any more, the journal does."""
    assert not listed(ROOT).keys() & {"broken", "passing"}
    broken = why("broken")
    assert (broken["status"], broken["cause"]) == ("Failed", "node-failed")
    assert broken["summary"] == "node only: exit code 3"
    assert [one["text"] for one in broken["last_lines"]] == ["no camera there"]
    passing = why("passing")
    assert (passing["status"], passing["is_failure"]) == ("Stopped", False), passing
    assert passing["stopped_by"] == "the shutdown of the machine"


def test_what_a_person_types_after_it() -> None:
    check_typed(AFTER)

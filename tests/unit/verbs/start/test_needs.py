"""What people are told about needs that may never be met."""

import pytest

from dora_systemd.decisions.needs.words import NodeNeed
from dora_systemd.decisions.properties.sandbox import Sandbox
from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.reason import need_failure
from dora_systemd.verbs.start.needs import Needy, check_needs, needs_warnings
from dora_systemd.verbs.stop import find_dependents, format_dependents
from tests.unit.fakes.manager import FakeManager, options

NEEDS = (NodeNeed("arm", "/dev/odd"), NodeNeed("arm", "/dev/video0"))


def test_a_device_without_a_group_may_stay_closed() -> None:
    (told,) = needs_warnings((), NEEDS, Sandbox(), ("/dev/odd rw",))
    assert told.startswith(
        "node arm waits for /dev/odd, but the sandbox opens it only if it is there at the start"
    )


def test_a_device_whose_group_is_allowed_is_not_told() -> None:
    assert not [*needs_warnings((), NEEDS, Sandbox(), ("char-odd rw",))]


def test_without_a_sandbox_nothing_is_closed() -> None:
    assert not [*needs_warnings((), (*NEEDS, NodeNeed("arm", "/tmp/map")), Sandbox("none"), ())]


def test_the_sandbox_has_its_own_tmp() -> None:
    (told,) = needs_warnings((), (NodeNeed("arm", "/tmp/map"),), Sandbox(), ())
    assert told == "node arm waits for /tmp/map, but the sandbox has its own /tmp"


@pytest.mark.parametrize("level", ["default", "none"])
def test_a_private_network_has_no_interfaces_of_the_machine(level: str) -> None:
    needs = (NodeNeed("arm", "net:can0"), NodeNeed("arm", "net:lo"))
    assert not [*needs_warnings((), needs, Sandbox(level), ())]
    (told,) = needs_warnings((), needs, Sandbox(level, "private"), ())
    assert told == "node arm waits for net:can0, but a private network has only net:lo"


def test_a_dataflow_that_is_needed_has_to_be_started() -> None:
    """Nothing can be enabled that systemd has not loaded."""
    with pytest.raises(DoraSystemdError, match="no dataflow named 'base'") as caught:
        check_needs(FakeManager(), Needy("arm", False, ("dataflow:base",)))
    assert caught.value.hint.startswith("start base first")
    assert "doractl enable" not in caught.value.hint


@pytest.mark.parametrize(("name", "other"), [("arm", "base"), ("base", "arm")])
def test_two_that_need_each_other_are_named_before_one_was_started(name: str, other: str) -> None:
    """Each start would else only say to start the other one first."""
    with pytest.raises(DoraSystemdError) as caught:
        check_needs(FakeManager(), Needy(name, False, (f"dataflow:{other}",)))
    assert f"if {other} needs {name}, they wait for each other" in caught.value.hint


def test_a_mount_needs_a_unit() -> None:
    """/proc is mounted, but not by a unit."""
    with pytest.raises(DoraSystemdError) as caught:
        check_needs(FakeManager(), Needy("arm", False, ("mount:/proc",)))
    assert "systemd has no mount unit for /proc, or for a directory above it" in str(caught.value)


def test_what_needs_a_dataflow_ends_with_it() -> None:
    """Also what needs it because of another one; what does not run is none of them."""
    manager = FakeManager()
    for name in ("base", "arm", "hand", "old", "other"):
        manager.add(options(name), active="failed" if name == "old" else "active")
    manager.units["dora-base.service"]["RequiredBy"] = ["dora-arm.service", "dora-old.service"]
    manager.units["dora-arm.service"]["RequiredBy"] = ["dora-hand.service", "foreign.service"]
    base = [one for one in read_cells(manager) if one.name == "base"]
    found = find_dependents(manager, base)
    assert [one.name for one in found] == ["arm", "hand"]
    assert format_dependents(base, found) == "arm, hand need base and end with it"
    assert format_dependents(base, found[:1]) == "arm needs base and ends with it"
    assert find_dependents(manager, found[1:]) == []
    assert format_dependents(base, []) == ""


@pytest.mark.parametrize(
    ("needed", "reason", "more"),
    [
        (["dora-base.service"], "dataflow base, which", "doractl --system why base"),
        (
            ["sshd.service"],
            "sshd.service, which it needs",
            "systemctl --system status sshd.service",
        ),
        (["dora-up.service"], "a unit that it needs failed", "systemctl --system --failed"),
    ],
)
def test_a_need_that_failed_is_named(needed: list[str], reason: str, more: str) -> None:
    manager = FakeManager()
    manager.add(options("base"), active="failed")
    manager.add(options("up"))
    found = need_failure(manager, "--system", ["dora-up.service", *needed])
    assert found[0].startswith(reason)
    assert found[1] == more

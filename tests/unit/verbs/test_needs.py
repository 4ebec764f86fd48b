"""What people are told about needs that may never be met."""

from dora_systemd.decisions.cell.needs import NodeNeed
from dora_systemd.verbs.needs.notes import needs_warnings

NEEDS = (NodeNeed("arm", "/dev/odd"), NodeNeed("arm", "/dev/video0"))


def test_a_device_without_a_group_may_stay_closed() -> None:
    (told,) = needs_warnings((), NEEDS, True, ("/dev/odd rw",))
    assert told.startswith(
        "node arm waits for /dev/odd, but the sandbox opens it only if it is there at the start"
    )


def test_a_device_whose_group_is_allowed_is_not_told() -> None:
    assert not [*needs_warnings((), NEEDS, True, ("char-odd rw",))]


def test_without_a_sandbox_nothing_is_closed() -> None:
    assert not [*needs_warnings((), (*NEEDS, NodeNeed("arm", "/tmp/map")), False, ())]


def test_the_sandbox_has_its_own_tmp() -> None:
    (told,) = needs_warnings((), (NodeNeed("arm", "/tmp/map"),), True, ())
    assert told == "node arm waits for /tmp/map, but the sandbox has its own /tmp"

"""What happens to nodes whose needs are missing, devices of the sandbox, what a start waits for."""

import pytest

from dora_systemd.decisions.cell.status import HELD, LATCHED, NODE_STATES, NodeStatus
from dora_systemd.decisions.needs.steps import Do, NeedStep, need_steps
from dora_systemd.decisions.needs.units import (
    device_entries,
    format_awaited,
    lone_devices,
    needs_can,
)
from dora_systemd.decisions.needs.words import NodeNeed

GONE = "/dev/video0 (not there)"
OPEN = frozenset({"camera"})


def steps(node: NodeStatus, missing: str, is_running: bool, passed: frozenset[str]) -> list[Do]:
    found = need_steps({"camera": node}, {"camera": missing}, is_running, passed)
    return [one.do for one in found]


def test_before_the_start_all_nodes_wait_for_the_last_need() -> None:
    nodes = {"camera": NodeStatus(), "arm": NodeStatus(), "sink": NodeStatus()}
    found = list(need_steps(nodes, {"camera": "", "arm": GONE}, False, frozenset()))
    assert found == [
        NeedStep(Do.HOLD, "arm", GONE),
        NeedStep(Do.HOLD, "camera", "node arm"),
    ]
    met = need_steps(nodes, {"camera": "", "arm": ""}, False, frozenset())
    assert [one.do for one in met] == [Do.LET_GO, Do.LET_GO]


def test_a_wait_is_told_once_for_each_reason() -> None:
    waiting = NodeStatus("waiting", needs=GONE)
    for is_running in (False, True):
        assert steps(waiting, GONE, is_running, frozenset()) == []
        assert steps(waiting, "/dev/video0 (no permission)", is_running, frozenset()) == [Do.HOLD]
        assert steps(waiting, "", is_running, frozenset()) == [Do.LET_GO]


@pytest.mark.parametrize("state", NODE_STATES)
def test_a_lost_device_ends_only_what_runs(state: str) -> None:
    ends = state in ("starting", "ready", "running", "restarting")
    expected = [Do.LOSE] if ends else [Do.HOLD] if state == "waiting" else []
    assert steps(NodeStatus(state), GONE, True, OPEN) == expected


@pytest.mark.parametrize("state", NODE_STATES)
def test_a_node_that_has_all_runs_on(state: str) -> None:
    assert steps(NodeStatus(state), "", True, OPEN) == ([Do.LET_GO] if state == "waiting" else [])


@pytest.mark.parametrize(
    ("policy", "missing", "expected"),
    [
        *((LATCHED, "", [Do.GIVE_UP]), (LATCHED, GONE, [Do.LOSE])),
        *((HELD, "", []), (HELD, GONE, [Do.LOSE]), ("never", GONE, []), ("always", GONE, [])),
    ],
)
def test_a_failed_node_waits_only_if_dora_can_still_replace_it(
    policy: str, missing: str, expected: list[Do]
) -> None:
    assert steps(NodeStatus("failed", policy=policy), missing, True, OPEN) == expected


def test_a_node_that_was_added_passes_its_gate() -> None:
    assert steps(NodeStatus("starting"), "", True, frozenset()) == [Do.LET_GO]
    assert steps(NodeStatus("starting"), GONE, True, frozenset()) == [Do.HOLD]


def test_the_sandbox_opens_the_group_of_a_device() -> None:
    paths = ("/dev/video0", "/dev/v4l/by-id/usb-x", "/dev/serial/by-id/y", "/dev/odd", "/srv/map")
    assert device_entries(NodeNeed("camera", path) for path in paths) == (
        *("char-video4linux rw", "char-ttyUSB rw", "char-ttyACM rw", "/dev/odd rw"),
    )


def test_a_can_bus_is_known_by_its_name() -> None:
    for name in ("can0", "vcan1", "arm-CAN"):
        assert needs_can([NodeNeed("log", "/srv/can"), NodeNeed("arm", f"net:{name}")])
    assert not needs_can([NodeNeed("arm", "/dev/can0"), NodeNeed("lidar", "net:eth0")])
    assert device_entries([NodeNeed("arm", "net:can0")]) == ()


def test_a_device_without_a_group_is_told() -> None:
    sandboxed = [NodeNeed("arm", f"/dev/{one}") for one in ("odd", "video0", "null", "shm/map")]
    assert lone_devices(sandboxed) == (NodeNeed("arm", "/dev/odd"),)


@pytest.mark.parametrize(
    ("units", "text"),
    [
        ((), ""),
        (("network-online.target",), "network"),
        (("time-sync.target", "chrony-wait.service"), "clock"),
        (("dora-base.service", "basic.target", "dora.slice"), "dataflow base"),
        (("basic.target", "dora.slice"), "basic.target, dora.slice"),
        (("data-my\\x2dmaps.mount",), "mount /data/my-maps"),
        (("-.mount",), "mount /"),
        (("\\x2ehidden.mount",), "mount /.hidden"),
        (
            ("e.service", "d.service", "c.service", "b.service"),
            "b.service, c.service, d.service and 1 more",
        ),
    ],
)
def test_what_a_start_waits_for(units: tuple[str, ...], text: str) -> None:
    assert format_awaited(units) == text

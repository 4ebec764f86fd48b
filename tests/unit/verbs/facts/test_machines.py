"""Where the other machines of a dataflow are, and who may change what on a member."""

import pytest

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.machines.link_command import LinkOptions, link_command
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import CONTROL, read_cells, refuse_parts, without_parts
from dora_systemd.verbs.facts.machines import member_hosts
from dora_systemd.verbs.set import set_limits
from tests.unit.fakes.manager import FakeManager, options

PLACED = (Placed("yolo", "gpu"), Placed("arm", "pi"))
LINK = LinkOptions("/run/x", "gpu", "alice@gpu-box:2222", ("member", "/srv/robot.yml"))
WORDS = link_command("/usr/bin/python3", LINK)


def test_hosts_are_those_of_the_links() -> None:
    manager = FakeManager()
    manager.units["doralink-robot:gpu.service"] = {"ExecStart": [[WORDS[0], WORDS, False]]}
    found = member_hosts(manager, options(placed=PLACED))
    assert found["gpu"] is not None
    assert (found["gpu"].destination, found["gpu"].port) == ("alice@gpu-box", "2222")
    assert found["pi"] is None
    assert member_hosts(manager, options(placed=PLACED, machine="gpu")) == {}
    assert member_hosts(manager, options()) == {}


def test_a_part_is_changed_on_its_head() -> None:
    manager = FakeManager()
    manager.add(options("robot", placed=PLACED, machine="gpu", head="robot-1"))
    manager.add(options("other", "660e8400-e29b-41d4-a716-446655440000"))
    cells = read_cells(manager)
    with pytest.raises(DoraSystemdError) as caught:
        refuse_parts(cells, "stop")
    assert caught.value.code is ExitCode.FAILURE
    assert "machine gpu, and the head is robot-1" in caught.value.message
    assert caught.value.hint == "on robot-1: doractl stop robot"
    with pytest.raises(DoraSystemdError) as caught:
        refuse_parts(cells, CONTROL)
    assert caught.value.message.startswith("cannot control robot here")
    assert caught.value.hint == "use doractl on robot-1"
    assert [cell.name for cell in without_parts(cells)] == ["other"]
    refuse_parts(without_parts(cells), "stop")


def test_limits_of_a_node_elsewhere() -> None:
    manager, scope = FakeManager(), Scope(is_user=True, uid=1000)
    manager.add(options("robot", placed=PLACED))
    (cell,) = read_cells(manager)
    with pytest.raises(DoraSystemdError, match="node yolo: it runs on machine gpu"):
        set_limits(manager, scope, cell, {"nodes": ("yolo:memory_limit=1G",)})
    with pytest.raises(DoraSystemdError, match="node arm: it runs on machine pi"):
        set_limits(
            manager, scope, cell, {"log_rate_limit": "9/1s", "nodes": "arm:log_rate_limit=1/1s"}
        )

"""Containers of nodes, in a fake cgroup tree and a fake /proc."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.verbs.facts.containers import (
    left_of,
    outside_of,
    outside_of_node,
    read_containers,
)
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.manager import FakeManager, options

ID, DOCKER = "a" * 64, "d" * 64
UNIT = "/dora.slice/dora-robot.service"
NODE = f"{UNIT}/node-policy"


class Machine:
    """Groups below `mount`, processes below `proc`."""

    def __init__(self, mount: Path, proc: Path) -> None:
        self.mount, self.proc = mount, proc

    def add(self, pid: int, group: str, *words: str, parent: int = 1, began: int = 100) -> None:
        """A process; began: in seconds since the boot."""
        place = self.mount / group[1:]
        place.mkdir(parents=True, exist_ok=True)
        (place / "memory.current").write_text("4096\n")
        (place / "cgroup.events").write_text("populated 1\n")
        with (place / "cgroup.procs").open("a") as file:
            file.write(f"{pid}\n")
        path = self.proc / str(pid)
        path.mkdir(parents=True)
        name = Path(words[0]).name
        (path / "comm").write_text(f"{name}\n")
        (path / "cmdline").write_text("".join(f"{one}\0" for one in words))
        (path / "cgroup").write_text(f"0::{group}\n")
        # The groups are of the user who runs this test, and so are the clients.
        (path / "status").write_text(f"Uid:\t0\t{os.getuid()}\t0\t0\nNSpid:\t7\n")
        (path / "stat").write_text(f"{pid} ({name}) S {parent}{' 0' * 17} {began * 100} 0 0\n")

    def read(self) -> dict[str, list[tuple[str, str, bool]]]:
        groups = {"": self.mount / UNIT[1:], "policy": self.mount / NODE[1:]}
        found = read_containers(groups, self.proc)
        return {
            node: [(one.program, one.id, one.is_inside) for one in some]
            for node, some in found.items()
        }


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    found = Machine(fake_cgroups(monkeypatch, tmp_path), tmp_path / "proc")
    found.add(10, NODE, "python3", "policy.py")
    return found


def test_no_containers(machine: Machine) -> None:
    assert machine.read() == {}


def test_podman_with_split_cgroups(machine: Machine) -> None:
    machine.add(11, f"{NODE}/runtime", "podman", "run", "x")
    machine.add(12, f"{NODE}/runtime", "conmon", "-c", ID, "-n", "hello")
    machine.add(13, f"{NODE}/libpod-payload-{ID}", "sleep", parent=12)
    assert machine.read() == {"policy": [("podman", ID, True)]}


def test_podman_in_a_scope(machine: Machine) -> None:
    machine.add(11, NODE, "podman", "run", "x")
    machine.add(12, f"/user.slice/libpod-conmon-{ID}.scope", "conmon", "-c", ID, began=101)
    machine.add(13, f"/user.slice/libpod-{ID}.scope/container", "sleep", parent=12)
    assert machine.read() == {"policy": [("podman", ID, False)]}


def test_whose_podman_stops_a_container(machine: Machine) -> None:
    """The owner chooses the name, which may be that of a container of root."""
    scope, uid = f"/user.slice/libpod-{ID}.scope/container", 54321
    for pid, group, words, parent in (
        (11, NODE, ("podman", "run", "x"), 1),
        (12, NODE, ("conmon", "-c", ID, "-n", "web"), 1),
        (13, scope, ("sleep",), 12),
    ):
        machine.add(pid, group, *words, parent=parent)
    groups = {"policy": machine.mount / NODE[1:]}
    (own,) = read_containers(groups, machine.proc)["policy"]
    assert own.remedy == "podman stop web"
    for pid in (11, 12):
        (machine.proc / f"{pid}/status").write_text(f"Uid:\t0\t{uid}\t0\t0\nNSpid:\t7\n")
    (hers,) = read_containers(groups, machine.proc)["policy"]
    assert hers.remedy == f"podman stop web, as uid {uid}"


def test_podman_that_has_not_begun(machine: Machine) -> None:
    machine.add(11, NODE, "podman", "run", "x")
    assert machine.read() == {}


def test_docker(machine: Machine) -> None:
    machine.add(11, NODE, "docker", "run", "x", began=200)
    assert machine.read() == {"policy": [("docker", "", False)]}
    machine.add(20, "/system.slice/docker-" + "c" * 64 + ".scope", "sleep", began=150)
    machine.add(21, f"/system.slice/docker-{DOCKER}.scope", "sleep", began=201)
    assert machine.read() == {"policy": [("docker", DOCKER, False)]}


def test_groups_in_a_node_without_end(machine: Machine) -> None:
    """Their user can create any number: a reader of all dataflows must not look at each."""
    for number in range(cgroup.MAX_GROUPS):
        (machine.mount / NODE[1:] / f"a{number:05}").mkdir()
    machine.add(11, f"{NODE}/z/z", "conmon", "-c", ID)
    assert machine.read() == {}


def test_what_a_stop_leaves(machine: Machine) -> None:
    """Not what is in another group of the unit, and not what has ended."""
    manager = FakeManager()
    unit = manager.add(options(), ControlGroup=UNIT)
    for number, node in enumerate(("policy", "second", "third")):
        id = f"{number:064}"
        place = f"{UNIT}/{id}" if node == "third" else f"/machine.slice/libpod-{id}.scope"
        machine.add(30 + number, f"{UNIT}/node-{node}", "conmon", "-c", id, "-n", node)
        machine.add(40 + number, place, "sleep", parent=30 + number)
    found = outside_of(manager, unit, machine.proc)
    assert [(node, one.name) for node, one in found] == [("policy", "policy"), ("second", "second")]
    (machine.mount / found[1][1].group[1:] / "cgroup.events").write_text("populated 0\n")
    assert [(node, one.memory) for node, one in left_of(found)] == [("policy", 4096)]


def test_a_unit_that_does_not_run() -> None:
    manager = FakeManager()
    assert outside_of(manager, manager.add(options(), active="failed")) == []


def test_of_one_node_only(machine: Machine) -> None:
    other = f"{UNIT}/node-eye"
    machine.add(20, NODE, "docker", "run", "x")
    machine.add(21, other, "docker", "run", "x", began=200)
    machine.add(22, f"/system.slice/docker-{DOCKER}.scope", "sleep", began=150)
    machine.add(23, f"/system.slice/docker-{'e' * 64}.scope", "sleep", began=250)
    manager = FakeManager()
    unit = manager.add(options(), ControlGroup=UNIT)
    found = outside_of_node(manager, unit, "eye", machine.proc)
    assert {one: [(node, c.id) for node, c in some] for one, some in found.items()} == {
        unit: [("eye", "e" * 64)]
    }

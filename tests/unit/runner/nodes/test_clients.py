"""Containers that nodes start outside of their cgroups: one event for each client."""

from pathlib import Path

from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.resources.containers import CLIENTS
from dora_systemd.runner.nodes.clients import PROGRAMS, ClientWatch


def process(proc: Path, pid: int, *arguments: str, parent: int = 1) -> None:
    place = proc / str(pid)
    place.mkdir(parents=True)
    name = arguments[0]
    (place / "comm").write_text(f"{name}\n")
    (place / "cmdline").write_text("".join(f"{one}\0" for one in arguments))
    fields = ["S", str(parent), *["0"] * 17, "5000", "0"]
    (place / "stat").write_text(f"{pid} ({name}) {' '.join(fields)}\n")
    (place / "status").write_text(f"Name:\t{name}\nUid:\t1000\t1000\t1000\t1000\n")


def group(root: Path, node: str, *pids: int) -> Path:
    place = root / f"node-{node}"
    place.mkdir(exist_ok=True)
    (place / "cgroup.procs").write_text("".join(f"{one}\n" for one in pids))
    return place


def outside(node: str, program: str, container: str = "") -> Record:
    return Record("container-outside", node, {"program": program, "container": container})


def test_the_programs_are_those_that_list_knows() -> None:
    assert {one.encode() for one in CLIENTS} == {*PROGRAMS}


def test_one_event_for_each_client(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 7, "python3", "policy.py")
    process(proc, 8, "docker", "run", "image")
    watch = ClientWatch(proc)
    groups = {"policy": group(tmp_path, "policy", 7), "eye": group(tmp_path, "eye")}
    assert watch.look(groups) == []
    group(tmp_path, "policy", 7, 8)
    assert watch.look(groups) == [outside("policy", "docker")]
    assert watch.look(groups) == [], "it has begun once"
    group(tmp_path, "policy", 7)
    assert watch.look(groups) == []
    process(proc, 9, "nerdctl", "run", "--name=b", "image")
    group(tmp_path, "policy", 7, 9, 10)
    assert watch.look(groups) == [outside("policy", "nerdctl", "b")], "10 has ended meanwhile"


def test_podman_executes_itself_again(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 8, "podman", "run", "--name", "outer", "image")
    process(proc, 9, "podman", "run", "--name", "outer", "image", parent=8)
    watch = ClientWatch(proc)
    groups = {"policy": group(tmp_path, "policy", 8, 9)}
    assert watch.look(groups) == [outside("policy", "podman", "outer")]


def test_what_is_no_container_outside(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 8, "podman", "run", "--cgroups=split", "image")
    process(proc, 9, "docker", "ps")
    watch = ClientWatch(proc)
    assert watch.look({"policy": group(tmp_path, "policy", 8, 9)}) == []

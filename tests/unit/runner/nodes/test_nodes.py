"""The runner's side of the nodes."""

import asyncio
import os
import resource
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from signal import SIGKILL

import pytest

from dora_systemd.adapters.cgroup.groups import kill_left
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.nodes import Nodes, _with_descendants, raise_file_limit
from tests.unit.adapters.logs.test_queue import SlowJournal
from tests.unit.fakes.rights_values import rights_from


@pytest.fixture
def few_files() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.usefixtures("few_files")
def test_more_nodes_than_a_process_has_files() -> None:
    raise_file_limit()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert soft == hard


@pytest.mark.parametrize("is_there", [True, False])
def test_the_kernel_is_told_before_the_nodes_move(tmp_path: Path, is_there: bool) -> None:
    """It moves the runner to where it is, and no error of that is one of the cell."""
    before = set(threading.enumerate())
    procs = tmp_path / "supervisor/cgroup.procs"
    if is_there:
        procs.parent.mkdir()
        procs.write_text("")

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        Nodes(tmp_path, CellPaths(tmp_path), pipes).expect()

    asyncio.run(live())
    for one in {*threading.enumerate()} - before:
        one.join()
    assert (procs.read_text() if procs.exists() else None) == ("0" if is_there else None)


def test_a_launcher_that_moves_meanwhile_is_found(tmp_path: Path) -> None:
    """It moves from the group of the daemon to that of its node while the two are read."""
    supervisor, own = (tmp_path / one / "cgroup.procs" for one in ("supervisor", "node-a"))
    for procs in (supervisor, own):
        procs.parent.mkdir()
    supervisor.write_text("8\n")
    os.mkfifo(own)  # what reads it sees that the process is not there yet

    def move() -> None:
        with own.open("w"):
            supervisor.write_text("")

    moving = threading.Thread(target=move)
    moving.start()

    async def find() -> bool:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        return Nodes(tmp_path, CellPaths(tmp_path), pipes).has_process("a", 8)

    assert asyncio.run(find())
    reader = os.open(own, os.O_RDONLY | os.O_NONBLOCK)  # it may not have opened its end yet
    moving.join()
    os.close(reader)


def test_a_node_that_dora_reads_is_removed_and_taken_back(tmp_path: Path) -> None:
    raw = {"id": "a", "path": "a.py", "outputs": ["said"], "send_stdout_as": "said"}
    dataflow = parse_dataflow({"nodes": [raw]}, "dataflow.yml")
    journal = SlowJournal()
    journal.make_room(100)
    log = tmp_path / "work/out/run/log_a.jsonl"
    log.parent.mkdir(parents=True)
    (tmp_path / "io").mkdir()

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), journal, Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(dataflow, {}, ())
        nodes.listen("run")
        nodes.remove("a")
        nodes.add(dataflow.nodes[0], {}, ())
        log.write_text("again\n")
        nodes.close()

    asyncio.run(live())
    assert b"MESSAGE=again\n" in b"".join(journal.taken)


SHA = {"id": "a", "path": "a", "path_sha256": "0" * 64}
OPERATOR = {"id": "a", "operator": {"python": "a.py"}}


@pytest.mark.parametrize(("raw", "is_lowered"), [(SHA, True), (OPERATOR, False)])
def test_only_a_node_without_a_launcher_is_lowered_from_outside(
    tmp_path: Path, raw: dict[str, object], is_lowered: bool
) -> None:
    """The launcher of an operator takes the limits by itself, once it has used them."""
    rights = (rights_from("b:essential=yes"),)
    (tmp_path / "io").mkdir()

    def score(child: subprocess.Popen[bytes]) -> int:
        return int(Path(f"/proc/{child.pid}/oom_score_adj").read_text())

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(parse_dataflow({"nodes": [raw]}, "dataflow.yml"), {}, ())
        with subprocess.Popen(["sleep", "60"]) as child:
            before = score(child)
            nodes.adopt("a", child.pid)
            assert score(child) == before
            nodes.adopt("a", child.pid, rights)
            assert (score(child) > before) is is_lowered
            child.kill()
        nodes.close()

    asyncio.run(live())


def test_an_operator_that_dies_while_it_is_adopted(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(path: object) -> None:
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(os, "scandir", gone)
    monkeypatch.setattr(os, "listdir", gone)
    assert _with_descendants(os.getpid()) == [os.getpid()]


def test_a_node_that_is_taken_back_is_held_as_before(tmp_path: Path) -> None:
    """dora has written more than the node may have unread, and the journal takes nothing."""
    raw = {"id": "a", "path": "a.py", "outputs": ["said"], "send_stdout_as": "said"}
    dataflow = parse_dataflow({"nodes": [raw | {"max_log_size": "1KB"}]}, "dataflow.yml")
    (tmp_path / "io").mkdir()
    freeze = tmp_path / "node-a/cgroup.freeze"
    log = tmp_path / "work/out/run/log_a.jsonl"
    log.parent.mkdir(parents=True)

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(dataflow, {}, ())
        nodes.listen("run")
        nodes.remove("a")
        nodes.add(dataflow.nodes[0], {}, ())
        freeze.write_text("0")
        log.write_text(f"{'x' * 999}\n" * 100)
        async with asyncio.timeout(30):
            while freeze.read_text() == "0":
                await asyncio.sleep(0.01)
        assert nodes.is_held("a")
        nodes.close()
        assert freeze.read_text() == "0"

    asyncio.run(live())


def test_what_enters_a_group_while_it_is_cleared_lives(tmp_path: Path) -> None:
    left, fork, entering = [subprocess.Popen(["sleep", "60"]) for _ in range(3)]
    procs = tmp_path / "cgroup.procs"
    procs.write_text(f"{left.pid}\n")
    later = iter([(True, fork), (True, entering), (False, entering)])

    def is_old() -> bool:
        answer, child = next(later)
        with procs.open("a") as file:
            print(child.pid, file=file)
        return answer

    kill_left(tmp_path, is_old, lambda *_: True)
    assert [left.wait(), fork.wait(), entering.poll()] == [-SIGKILL, -SIGKILL, None]
    entering.kill()
    entering.wait()


def test_what_may_get_no_signal_of_ours_is_killed_by_the_kernel(tmp_path: Path) -> None:
    """A program with the rights of another user: pidfd_send_signal(2) is refused."""

    def refuse(*_: object) -> bool:
        raise PermissionError

    (tmp_path / "cgroup.procs").write_text(f"{os.getpid()}\n")
    (tmp_path / "cgroup.kill").touch()
    kill_left(tmp_path, lambda: True, refuse)
    assert (tmp_path / "cgroup.kill").read_text() == "1"

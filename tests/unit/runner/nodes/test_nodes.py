"""The runner's side of the nodes."""

import asyncio
import os
import resource
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

from dora_systemd.adapters.host import process
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.log_backlog import Marks
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.decisions.rights.node_rights import parse_node_rights
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes import nodes as nodes_module
from dora_systemd.runner.nodes.descriptors import raise_file_limit
from dora_systemd.runner.nodes.hold import Hold
from dora_systemd.runner.nodes.nodes import Nodes, _with_descendants
from tests.unit.adapters.logs.test_queue import SlowJournal


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
def test_the_kernel_is_told_before_the_nodes_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool
) -> None:
    """It moves the runner to where it is, and no error of that is one of the cell."""
    threads: list[Future[None]] = []

    def beside(call: Callable[[], None]) -> None:
        threads.append(process.beside(call))

    monkeypatch.setattr(nodes_module, "beside", beside)
    procs = tmp_path / "supervisor/cgroup.procs"
    if is_there:
        procs.parent.mkdir()
        procs.write_text("")

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        Nodes(tmp_path, CellPaths(tmp_path), pipes).expect()

    asyncio.run(live())
    if is_there:
        threads[0].result()
        assert procs.read_text() == "0"


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raw: dict[str, object], is_lowered: bool
) -> None:
    """The launcher of an operator takes the limits by itself, once it has used them."""
    lowered: list[object] = []
    monkeypatch.setattr(nodes_module, "lower_rights", lambda *given: lowered.append(given))
    monkeypatch.setattr(nodes_module, "_with_descendants", lambda pid: [pid])
    rights = (parse_node_rights("b:scheduling=fifo:5"),)
    (tmp_path / "io").mkdir()

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(parse_dataflow({"nodes": [raw]}, "dataflow.yml"), {}, ())
        nodes.adopt("a", 7)
        nodes.adopt("a", 7, rights)
        nodes.close()

    asyncio.run(live())
    assert lowered == [(7, "a", rights)] * is_lowered


def test_an_operator_that_dies_while_it_is_adopted(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(path: object) -> None:
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(os, "scandir", gone)
    monkeypatch.setattr(os, "listdir", gone)
    assert _with_descendants(os.getpid()) == [os.getpid()]


def test_a_node_that_is_taken_back_is_held_as_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Hold] = []
    looked: list[Hold] = []

    class Noted(Hold):
        def __init__(self, group: Path, marks: Marks) -> None:
            super().__init__(group, marks)
            made.append(self)

        def look(self, backlog: int) -> None:
            looked.append(self)
            super().look(backlog)

    monkeypatch.setattr(nodes_module, "Hold", Noted)
    raw = {"id": "a", "path": "a.py", "outputs": ["said"], "send_stdout_as": "said"}
    dataflow = parse_dataflow({"nodes": [raw]}, "dataflow.yml")
    (tmp_path / "io").mkdir()

    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), SlowJournal(), Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(dataflow, {}, ())
        nodes.listen("run")
        nodes.remove("a")
        nodes.add(dataflow.nodes[0], {}, ())
        async with asyncio.timeout(30):
            while made[1] not in looked:
                await asyncio.sleep(0.01)
        nodes.close()

    asyncio.run(live())

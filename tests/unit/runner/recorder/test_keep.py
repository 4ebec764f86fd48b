"""The recorder among the nodes of a run, and the memory of its ring."""

import asyncio
import os
import socket
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.dora.probe import total_memory
from dora_systemd.adapters.host import fd_store
from dora_systemd.decisions.cell.extra import RECORDER, extra_id
from dora_systemd.decisions.cell.options import SettingText
from dora_systemd.decisions.recorder.record import Record, limit_of
from dora_systemd.decisions.recorder.ring import ALIGN, parse_header
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.recorder.keep import (
    Recorder,
    Rings,
    RingSocket,
    fitted_ring,
    free_ring,
    header_of,
    keep_recorder,
)
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.swap import Swapper
from tests.unit.fakes.loop import live
from tests.unit.fakes.reload import ReloadBench

RECORD = Record(outputs=("a/image",))
MEGABYTE = 1024 * 1024


class Bench(ReloadBench):
    """A recorder that the test starts and ends."""

    def __init__(self, root: Path, python: str = "/venv/bin/python") -> None:
        super().__init__(root)
        self.python = python
        self.record = Recorder(
            *(self.run_of_it(), self.dora, self.prepared.plan, RECORD, ("a/image", "b/x")),
            self.find_python,
        )
        self.group = root / f"node-{RECORDER}"
        self.group.mkdir()
        for name in ("memory.max", "memory.swap.max", "cpu.weight"):
            (self.group / name).write_text("")
        self.dora.then["AddNode"] = lambda: self.populate(True)

    def run_of_it(self) -> Run:
        return Run(self.pump, self.nodes, self.pipes, Swapper(self.pump, self.dora))

    async def find_python(self) -> str:
        if not self.python:
            raise DoraSystemdError("no Python here has dora-rs")
        return self.python

    def populate(self, is_there: bool) -> None:
        (self.group / "cgroup.events").write_text(f"populated {int(is_there)}\nfrozen 0\n")

    async def work(self, seconds: float) -> None:
        task = asyncio.create_task(self.record.work())
        await asyncio.sleep(seconds)
        assert not task.done()
        task.cancel()

    def added(self) -> list[Any]:
        return [one["AddNode"]["node"] for one in self.dora.asked if "AddNode" in one]  # type: ignore[index]

    def reasons(self) -> list[Any]:
        events = self.pipes.events
        return [details["reason"] for name, _, details in events if name == "outputs-unrecorded"]


def lived(root: Path, seconds: float, does_end: bool = False, python: str = "/p") -> Bench:
    benches: list[Bench] = []

    async def begin() -> None:
        await asyncio.sleep(1000)  # a machine that has been up for a while
        benches.append(Bench(root, python))
        if does_end:
            benches[0].dora.then["AddNode"] = lambda: benches[0].populate(False)
        await benches[0].work(seconds)

    live(begin)
    return benches[0]


def test_a_node_of_its_own_within_limits(tmp_path: Path) -> None:
    bench = lived(tmp_path, 100)
    (node,) = bench.added()
    assert node["id"] == extra_id(RECORDER, 1)
    assert node["inputs"] == {
        "0": {"source": "a/image", "queue_size": 4},
        "1": {"source": "b/x", "queue_size": 4},
    }
    assert f"{RECORDER} / keep /p -u " in node["args"]
    assert str(tmp_path / "ring.sock") in node["args"]
    limit = limit_of(RECORD, total_memory())
    assert (bench.group / "memory.max").read_text() == str(limit)
    assert node["env"]["MALLOC_MMAP_THRESHOLD_"]
    assert (bench.group / "cpu.weight").read_text() == "10"
    assert bench.reasons() == []


def test_an_end_on_request_is_no_failure_and_gets_time(tmp_path: Path) -> None:
    async def begin() -> None:
        await asyncio.sleep(1000)
        bench = Bench(tmp_path)
        await bench.work(5)
        await bench.record.end()
        removed: Any = bench.dora.asked[-1]["RemoveNode"]  # type: ignore[index]
        assert (removed["node_id"], removed["grace_duration"]["secs"]) == (extra_id(RECORDER, 1), 5)
        assert bench.pipes.expected == [extra_id(RECORDER, 1)]
        assert (bench.group / "cpu.weight").read_text() == "100"

    live(begin)


def test_one_that_ends_again_and_again_is_reported_once(tmp_path: Path) -> None:
    bench = lived(tmp_path, 100, does_end=True)
    assert len(bench.added()) > 8
    assert bench.reasons() == ["the recorder ended again and again"]
    assert bench.states() == {"a": "running", "b": "running"}


def test_without_a_python_it_says_so(tmp_path: Path) -> None:
    bench = lived(tmp_path, 100, python="")
    assert bench.added() == []
    assert bench.reasons() == ["no Python here has dora-rs"]


def test_the_ring_is_kept_by_systemd_over_lives(tmp_path: Path, monkeypatch: Any) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        header = header_of(RECORD, ["a/image"], {"boot": "1"})
        ring = fitted_ring(-1, header)
        text, fds, _, _ = socket.recv_fds(systemd, 1000, 4)
        assert text == b"FDSTORE=1\nFDNAME=dora-ring\nFDPOLL=0"
        assert os.path.samestat(os.fstat(fds[0]), os.fstat(ring))
        with pytest.raises(PermissionError):
            os.ftruncate(ring, 5)
        later = header._replace(facts={"boot": "2"})
        assert fitted_ring(ring, later) == ring
        assert parse_header(os.pread(ring, ALIGN, 0)).facts == {"boot": "2"}
        other = fitted_ring(ring, header_of(RECORD, ["a/image", "b/x"], {}))
        assert systemd.recv(1000) == b"FDSTOREREMOVE=1\nFDNAME=dora-ring"
        assert len(parse_header(os.pread(other, ALIGN, 0)).outputs) == 2
        systemd.recv(1000)
        rings = Rings(other)
        rings.free()
        assert rings.fd == -1
        assert systemd.recv(1000) == b"FDSTOREREMOVE=1\nFDNAME=dora-ring"
        free_ring(-1)
        os.close(fds[0])


def test_an_earlier_life_leaves_its_ring(monkeypatch: Any) -> None:
    monkeypatch.setenv("LISTEN_PID", str(os.getpid()))
    monkeypatch.setenv("LISTEN_FDNAMES", "")
    assert fd_store.inherited_ring() == -1
    ring = os.memfd_create("ring")
    os.set_inheritable(ring, True)
    names = ["other" for _ in range(3, ring)]
    monkeypatch.setenv("LISTEN_FDNAMES", ":".join([*names, fd_store.RING]))
    assert fd_store.inherited_ring() == ring
    assert not os.get_inheritable(ring)
    os.close(ring)


def test_too_many_outputs_are_reported(tmp_path: Path) -> None:
    bench: list[Bench] = []

    async def begin() -> None:
        bench.append(Bench(tmp_path))
        names = "+".join(f"a/o{at}" for at in range(300))
        prepared = prepared_with(bench[0], f"outputs={names}")
        recording = keep_recorder(bench[0].run_of_it(), prepared, bench[0].dora, Rings(-1))
        task = asyncio.create_task(recording)
        await asyncio.sleep(5)
        task.cancel()

    live(begin)
    assert bench[0].reasons() == ["cannot record all outputs: too many outputs, or too long names"]


def prepared_with(bench: Bench, text: str) -> Any:
    plan = bench.prepared.plan
    options = plan.options._replace(settings=(SettingText("", "record", text),))
    return bench.prepared._replace(plan=plan._replace(options=options))


def test_doractl_set_changes_what_is_recorded(tmp_path: Path) -> None:
    async def others(request: Any) -> dict[str, Any]:
        return {"others": request["verb"]}

    async def begin() -> None:
        bench, rings = Bench(tmp_path), Rings(-1)
        with pytest.raises(DoraSystemdError, match="no node runs"):
            await rings.answer({"verb": "record", "what": "no"}, others)
        prepared = prepared_with(bench, "memory=2M")
        recording = keep_recorder(bench.run_of_it(), prepared, bench.dora, rings)
        task = asyncio.create_task(recording)
        await asyncio.sleep(5)
        assert rings.record == Record(memory=2 * MEGABYTE)
        assert rings.fd == -1, "its nodes have no outputs"
        for what, words in (("outputs=a/x", "no such output"), ("memory=100T", "100T"), ("?", "?")):
            with pytest.raises(DoraSystemdError) as caught:
                await rings.answer({"verb": "record", "what": what}, others)
            assert words in caught.value.message
        assert rings.record == Record(memory=2 * MEGABYTE)
        assert await rings.answer({"verb": "reload"}, others) == {"others": "reload"}
        assert await rings.answer({"verb": "record", "what": "no"}, others) == {"done": []}
        rings.begin(prepared)  # a reload with the same options
        assert [rings.record] == [None]
        rings.begin(prepared_with(bench, "memory=3M"))
        assert rings.record == Record(memory=3 * MEGABYTE)
        task.cancel()

    live(begin)


def test_whoever_connects_gets_the_ring(tmp_path: Path) -> None:
    async def begin() -> None:
        ring = fitted_ring(-1, header_of(RECORD, ["a/image"], {}))
        served = RingSocket(tmp_path / "s", ring)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.connect(str(tmp_path / "s"))
            served._answer()
            _, (fd,), _, _ = socket.recv_fds(connection, 1, 1)
        assert os.path.samestat(os.fstat(fd), os.fstat(ring))
        served.close()
        os.close(fd)
        os.close(ring)

    asyncio.run(begin())

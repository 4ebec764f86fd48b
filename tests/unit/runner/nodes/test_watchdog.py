"""The notify sockets of nodes, and the watch over their watchdogs; time passes at once."""

import asyncio
import os
import signal
import socket
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from errno import EINVAL, EPERM, ESRCH
from pathlib import Path
from signal import SIGABRT, SIGKILL, Signals

import pytest

from dora_systemd.adapters.cgroup.groups import is_member, signal_group
from dora_systemd.adapters.host import notify_socket
from dora_systemd.adapters.host.notify_socket import NotifySocket
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.decisions.watchdog.messages import Sign, parse_message
from dora_systemd.decisions.watchdog.watchdogs import Watchdogs
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.nodes.watchdog import NotifySockets, Processes, WatchdogTimers
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.dialogue import OPTIONS, Bench
from tests.unit.fakes.loop import live

WATCHDOGS: Watchdogs = {"cam": 5 * SECOND, "plot": INFINITY}


class Sockets:
    """Two nodes with sockets. own: pids of the node cam. told: life events."""

    def __init__(self, root: Path) -> None:
        self.own = {os.getpid()}
        self.told: list[tuple[str, str, str]] = []
        self.news = 0
        paths = CellPaths(root)
        paths.io.mkdir()
        self.sockets = NotifySockets(WATCHDOGS, root, paths, self.tell, self.is_member)
        self.place = str(paths.node_notify("cam"))
        for node in ("cam", "plot", "other"):
            self.sockets.make(node)
        self.sockets.on_news = self.count

    def is_member(self, path: Path, pid: int) -> bool:
        return path.name == "node-cam" and pid in self.own

    def tell(self, name: str, node: str, **details: str) -> None:
        self.told.append((name, node, details["reason"]))

    def count(self) -> None:
        self.news += 1

    def send(self, *texts: bytes) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            for text in texts:
                notify.sendto(text, self.place)

    def close(self) -> None:
        """Leave no socket."""
        for node, _ in self.sockets.items():
            self.sockets.remove(node)

    async def until(self, is_so: Callable[[], object]) -> None:
        async with asyncio.timeout(60):
            while not is_so():
                await asyncio.sleep(0.001)


Open = Callable[[], AbstractContextManager[Sockets]]


@pytest.fixture
def sockets(tmp_path: Path) -> Open:
    return lambda: closing(Sockets(tmp_path))


def test_only_a_watchdog_needs_sockets(tmp_path: Path) -> None:
    async def live() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), JournalSocket(), Origin("robot", "uuid"))
        for watchdogs in ({}, WATCHDOGS):
            nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes, watchdogs)
            assert (nodes.notify_sockets is not None) is bool(watchdogs)
            assert nodes.signs() == {}

    asyncio.run(live())


def test_what_a_node_says(sockets: Open, tmp_path: Path) -> None:
    async def live() -> None:
        with sockets() as one:
            assert one.sockets.table() == {"cam": Sign(watchdog=5 * SECOND), "plot": Sign()}
            one.send(b"STATUS=up\nWATCHDOG=1")
            await one.until(lambda: one.news)
            sign = one.sockets.table()["cam"]
            assert (sign.status, sign.at_us > 0) == ("up", True)
            one.send(b"WATCHDOG=trigger")
            await one.until(lambda: one.news == 2)
            assert [found.is_triggered for _, found in one.sockets.items()] == [True, False]
            one.sockets.forget("cam")
            assert one.sockets.table()["cam"] == Sign(watchdog=5 * SECOND)
            assert [found.is_triggered for _, found in one.sockets.items()] == [False, False]
            one.sockets.remove("cam")
            one.sockets.remove("cam")
            assert sorted(path.name for path in (tmp_path / "io").iterdir()) == ["plot.notify"]
            one.sockets.make("cam")
            one.send(b"STATUS=again")
            await one.until(lambda: one.news == 3)

    asyncio.run(live())


def test_another_process_is_not_believed(sockets: Open) -> None:
    async def live() -> None:
        with sockets() as one:
            one.own.clear()
            one.send(b"WATCHDOG=1\nSTATUS=fake", b"WATCHDOG=trigger")
            await one.until(lambda: one.told)
            one.sockets.drain("cam", next(iter(one.sockets.items()))[1])
            reason = f"process {os.getpid()} is not in the cgroup of the node"
            assert one.told == [("notify-refused", "cam", reason)], "reported once"
            assert one.news == 0
            assert one.sockets.table()["cam"] == Sign(watchdog=5 * SECOND)

    asyncio.run(live())


def test_a_sender_that_has_exited_is_not_believed(sockets: Open) -> None:
    script = "import socket, sys; s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM); "
    script += "s.sendto(b'WATCHDOG=1', sys.argv[1])"

    async def live() -> None:
        with sockets() as one:
            one.own = set(range(1, 2**22))  # whatever its pid: a later process may have it
            subprocess.run([sys.executable, "-I", "-S", "-c", script, one.place], check=True)
            await one.until(lambda: one.told or one.news)
            assert one.news == 0
            assert one.told[0][2].startswith("its sender had exited")

    asyncio.run(live())


def test_a_flood_leaves_time_for_others(sockets: Open) -> None:
    turns = 0
    heard: Counter[int] = Counter()

    async def live() -> None:
        nonlocal turns
        with sockets() as one:
            one.sockets.on_news = lambda: heard.update([turns])
            flood = asyncio.create_task(asyncio.to_thread(one.send, *[b"STATUS=x"] * 500))
            async with asyncio.timeout(60):
                while heard.total() < 500:
                    turns += 1
                    await asyncio.sleep(0)
            await flood

    asyncio.run(live())
    assert max(heard.values()) <= 32, "in one turn of the loop"


def test_descriptors_and_barriers(tmp_path: Path) -> None:
    """A descriptor that comes along is closed: a sender waits for that."""
    before = len(list(Path("/proc/self/fd").iterdir()))
    ear = NotifySocket(tmp_path / "n")
    read, write = os.pipe()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.connect(str(tmp_path / "n"))
        socket.send_fds(notify, [b"BARRIER=1"], [write])
        socket.send_fds(notify, [b"FDSTORE=1"], [write] * 50)
        notify.send(b"x" * 5000)
    os.close(write)
    for text in (b"BARRIER=1", b"FDSTORE=1", b""):
        pending = ear.receive()
        assert pending is not None
        with pending:
            assert (pending.data, pending.pid, pending.is_there()) == (text, os.getpid(), True)
    assert ear.receive() is None
    assert os.read(read, 1) == b"", "all copies are closed"
    os.close(read)
    ear.close()
    ear.close()
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_a_path_that_is_too_long(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="a path has at most 107 bytes"):
        NotifySocket(tmp_path / ("n" * 107))


def test_members(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mount = fake_cgroups(monkeypatch, tmp_path)
    groups = {3: "/u/node-a", 5: "/u/node-a/below", 7: "/u/node-ab"}
    found = [
        is_member(mount / "u/node-a", pid, lambda pid: groups.get(pid, "/")) for pid in (3, 5, 7, 9)
    ]
    assert found == [True, True, False, False]


def test_who_is_in_a_group_gets_a_signal(tmp_path: Path) -> None:
    """The main process first; who has left the group gets none."""
    children = [subprocess.Popen(["sleep", "60"]) for _ in range(3)]
    one, main, left = children
    asked: list[int] = []

    def is_in(_group: Path, pid: int) -> bool:
        asked.append(pid)
        return pid != left.pid

    (tmp_path / "cgroup.procs").write_text("".join(f"{child.pid}\n" for child in children))
    signal_group(tmp_path, SIGABRT, main.pid, is_in)
    assert [one.wait(), main.wait(), left.poll()] == [-SIGABRT, -SIGABRT, None]
    assert asked == [main.pid, one.pid, left.pid]
    left.kill()
    left.wait()
    signal_group(tmp_path, SIGABRT, main.pid, is_in)
    assert len(asked) == 3, "all have exited"


@pytest.mark.parametrize(
    ("number", "is_there"), [(0, True), (EPERM, True), (EINVAL, True), (ESRCH, False)]
)
def test_a_sender_that_gets_no_signal_of_ours(
    number: int, is_there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: int) -> None:
        if number:
            raise OSError(number, "no")

    monkeypatch.setattr(signal, "pidfd_send_signal", refuse)
    credentials = socket.SOL_SOCKET, socket.SCM_CREDENTIALS, struct.pack("iII", 7, 0, 0)
    read, write = os.pipe()
    os.close(write)
    with notify_socket.Pending(b"", [credentials, (1, 4, struct.pack("i", read))]) as pending:
        assert pending.is_there() is is_there


LIMIT = 4 * SECOND


class FakeProcesses:
    """A node "a" whose process has the pid `now`. done: what was sent to the node."""

    def __init__(self) -> None:
        self.now, self.is_busy = 7, False
        self.done: list[tuple[Signals, int]] = []

    def is_blocked(self, node: str) -> bool:
        del node
        return self.is_busy

    def find_own(self, node: str, pid: int) -> list[int]:
        del node
        return [pid] * (pid == self.now)

    def clear(self, node: str, pid: int) -> None:
        self.done += [(SIGKILL, one) for one in self.find_own(node, pid)]

    def send(self, _group: Path, number: Signals, some: Iterable[int]) -> None:
        self.done += [(number, one) for one in some]


class Watched(Bench):
    """A node "a" with pid 7. now: CLOCK_MONOTONIC µs. given: its processes, if they are real."""

    def __init__(self, root: Path, given: Callable[[LogPipes], Processes] | None = None) -> None:
        super().__init__(root)
        self.now = SECOND
        self.processes = FakeProcesses()
        paths = CellPaths(root)
        paths.io.mkdir(exist_ok=True)
        tell = self.pipes.write_event
        sockets = NotifySockets({"a": LIMIT}, root, paths, tell, clock_us=lambda: self.now)
        sockets.make("a")
        self.sockets, self.nodes.notify_sockets = sockets, sockets
        options = OPTIONS._replace(grace=2 * SECOND)
        processes = given(self.pipes) if given else self.processes
        self.watch = WatchdogTimers(sockets, self.pump, processes, options, self.processes.send)
        ((_, self.socket),) = sockets.items()

    @property
    def done(self) -> list[tuple[Signals, int]]:
        return self.processes.done

    def close(self) -> None:
        """Leave no socket."""
        self.sockets.remove("a")

    def passes(self, seconds: float) -> None:
        """Let time pass, with a look each half second."""
        for _ in range(int(seconds * 2)):
            self.now += SECOND // 2
            self.watch._look()


def watched(tmp_path: Path) -> AbstractContextManager[Watched]:
    return closing(Watched(tmp_path))


def test_a_silent_node_is_ended_then_killed(tmp_path: Path) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.passes(1)
            one.socket.receive(parse_message(b"WATCHDOG=1\nSTATUS=up"), one.sockets.clock)
            one.passes(3.5)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]
            reason, details = "no WATCHDOG=1 for 4s", {"status": "up"}
            assert one.heard == [life.NodeHung(0, "a", reason, "node-watchdog", details)]
            one.passes(10)
            assert one.done == [(SIGABRT, 7), (SIGKILL, 7)], "it has not ended by itself"

    live(work)


def test_the_next_process_is_spared(tmp_path: Path) -> None:
    """dora has replaced the process, and the runner learns of it later."""
    (tmp_path / "io").mkdir()
    group, note = tmp_path / "node-a", CellPaths(tmp_path).node_pid("a")
    dataflow = parse_dataflow({"nodes": [{"id": "a", "path": "a.py"}]}, "dataflow.yml")

    def prepare(pipes: LogPipes) -> Nodes:
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(dataflow, {}, ())
        return nodes

    def enter(*pids: int) -> None:
        note.write_text(f"{pids[0]}\n")
        (group / "cgroup.procs").write_text("".join(f"{pid}\n" for pid in sorted(pids)))

    async def work() -> None:
        with closing(Watched(tmp_path, prepare)) as one:
            (group / "cgroup.kill").touch()
            enter(8)
            one.passes(5)
            assert (one.heard, one.done) == ([], []), "it has missed nothing"
            enter(7, 6)
            one.passes(1)
            assert one.done == [(SIGABRT, 7), (SIGABRT, 6)]
            enter(8, 6)
            one.passes(100)
            assert (one.done[2:], (group / "cgroup.kill").read_text()) == ([], "")

    live(work)


@pytest.mark.parametrize("state", [State.WAITING, State.STOPPING, State.CLOSING])
def test_only_a_running_dataflow_is_watched(tmp_path: Path, state: State) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.enter(state)
            one.passes(100)
            assert one.done == []

    live(work)


@pytest.mark.parametrize("state", ["restarting", "reloading", "finished", "failed", "ready"])
def test_only_a_running_node_is_watched(tmp_path: Path, state: str) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.pump.cell = replace(one.pump.cell, nodes={"a": NodeStatus(state, 7)})
            one.passes(100)
            assert one.done == []

    live(work)


def test_a_start_that_takes_too_long(tmp_path: Path) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.pump.cell = replace(one.pump.cell, nodes={"a": NodeStatus("starting", 7)})
            one.passes(90)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]
            (hung,) = one.heard
            assert isinstance(hung, life.NodeHung)
            assert hung.reason == "not ready within 1min 30s"

    live(work)


def test_a_node_that_waits_for_the_journal(tmp_path: Path) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.processes.is_busy = True
            one.passes(100)
            one.processes.is_busy = False
            one.passes(3.5)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]

    live(work)


def test_it_asks_for_its_end_and_the_table_is_written(tmp_path: Path) -> None:
    async def work() -> None:
        with watched(tmp_path) as one:
            one.passes(1)
            one.socket.receive(parse_message(b"WATCHDOG=trigger\nSTATUS=bye"), one.sockets.clock)
            one.watch._hear_news()
            one.watch._hear_news()
            one.watch._publish()
            assert one.done == [(SIGABRT, 7)]
            assert Sign("bye", 0, LIMIT) == one.sockets.table()["a"]
            assert '"bye"' in CellPaths(tmp_path).status.read_text()
            one.watch._publish()
            assert one.done == [(SIGABRT, 7)], "once"

    live(work)

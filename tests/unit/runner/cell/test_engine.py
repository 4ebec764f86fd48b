"""Coordinator and daemon as the runner starts, asks and ends them: with a dora that is a script."""

import asyncio
import json
import os
import signal
import stat
from collections.abc import Callable, Coroutine
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve

from dora_systemd.adapters.dora import engine
from dora_systemd.adapters.host.process import beside
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.dora.protocol import LogRecord
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import start_coordinator
from dora_systemd.runner.cell.boot import Boot
from dora_systemd.runner.cell.engine import Engine
from tests.unit.fakes.loop import settle, within
from tests.unit.fakes.programs import make_program

SCRIPT = """
env > "$1.env"
echo "$*" > "$1.arguments"
pwd -P > "$1.directory"
echo ready
exec sleep 1000
"""
RUN = "run-1"


class Bench:
    """An engine in `root`, whose dora notes how it was started and waits for signals."""

    def __init__(self, root: Path) -> None:
        self.paths = CellPaths(root)
        dora = root / "dora"
        make_program(dora, SCRIPT)
        self.paths.work.mkdir()
        self.children: list[engine.Child] = []
        self.engine = Engine(str(dora), self.paths, {"PATH": "/usr/bin:/bin", "MODEL": "yolo"})

    def coordinator(self) -> engine.Child:
        return self._ready(self.engine.start_coordinator())

    def daemon(self, port: int = 4711) -> engine.Child:
        self.paths.coordinator.mkdir(exist_ok=True)
        (self.paths.coordinator / ".dora-token").write_text("secret\n")
        self.engine.set_port(port)
        return self._ready(self.engine.start_daemon({"ADDED": "1"}))

    def _ready(self, child: engine.Child) -> engine.Child:
        self.children.append(child)
        assert os.read(child.output, 100) == b"ready\n"
        return child

    def end(self) -> None:
        self.engine.kill()
        for child in self.children:
            os.close(child.output)
            child.popen.wait(20)  # a slow machine takes longer than the runner waits


def live(root: Path, work: Callable[[Bench], Coroutine[Any, Any, None]]) -> None:
    async def bounded() -> None:
        bench = Bench(root)
        try:
            await within(20, work(bench))
        finally:
            bench.end()

    asyncio.run(bounded())


def environment(directory: Path, name: str) -> dict[str, str]:
    lines = (directory / f"{name}.env").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines)


def test_the_coordinator_writes_its_token_in_a_directory_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOT_FOR_DORA", "1")

    async def work(bench: Bench) -> None:
        assert bench.coordinator().label == "coordinator"
        place = bench.paths.coordinator
        given = environment(place, "coordinator")
        assert given["XDG_CONFIG_HOME"] == given["TMPDIR"] == str(place)
        assert given["MODEL"] == "yolo"
        assert "NOT_FOR_DORA" not in given
        assert (place / "coordinator.directory").read_text().strip() == str(place.resolve())
        assert stat.S_IMODE(place.stat().st_mode) == 0o700

    live(tmp_path, work)


BOOTS = """
[ "$1" = daemon ] && exec sleep 1000
echo secret > .dora-token
echo "Listening on port 4711"
exec sleep 1000
"""


def booting(bench: Bench, script: str = BOOTS, kind: type[Boot] = Boot) -> Boot:
    """A dora that boots before there is an engine, which is told of it."""
    dora = bench.paths.root / "dora"
    make_program(dora, script)
    environment = {"PATH": "/usr/bin:/bin"}
    coordinator = start_coordinator(str(dora), bench.paths, environment)
    options = RunnerOptions("robot", "uuid", "/p/d.yml", "/p", str(dora))
    boot = kind(coordinator, options, bench.paths, bench.paths.root, environment)
    bench.engine = Engine(str(dora), bench.paths, environment, boot)
    bench.children.append(coordinator)
    return boot


def test_what_boots_already_is_not_started_again(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        (tmp_path / "cgroup.controllers").write_text("cpu\n")
        (tmp_path / "cgroup.subtree_control").write_text("")
        boot = booting(bench)
        daemon = boot.daemon()
        assert daemon
        assert boot.listens()
        assert (tmp_path / "cgroup.subtree_control").read_text() == "+cpu"
        assert boot.coordinator.said == b"Listening on port 4711\n"
        assert bench.engine.start_coordinator() is boot.coordinator
        bench.engine.set_port(4711)
        assert bench.engine.start_daemon({}) is daemon.child
        access = json.loads(bench.paths.control.read_text())
        assert access == {"port": 4711, "token": "secret", "local_listen_port": daemon.listen}
        bench.children.append(daemon.child)
        bench.engine.kill()
        ends = [one.popen.wait(20) for one in (boot.coordinator, daemon.child)]
        assert ends == [-signal.SIGKILL] * 2

    live(tmp_path, work)


def test_a_daemon_that_nobody_has_asked_for_yet_is_killed_too(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        boot = booting(bench)
        bench.engine.kill()
        daemon = boot.daemon()
        assert daemon
        assert daemon.child.popen.wait(20) == -signal.SIGKILL
        bench.children.append(daemon.child)
        boot.coordinator.popen.kill()
        os.close(boot.coordinator.pidfd)

    live(tmp_path, work)


@pytest.mark.parametrize("script", ["echo failed", BOOTS.replace("secret >", ">&2 ")])
def test_a_boot_that_fails_leaves_the_daemon_to_the_engine(tmp_path: Path, script: str) -> None:
    async def work(bench: Bench) -> None:
        boot = booting(bench, script)
        assert boot.daemon() is None
        assert boot.listens() == ("Listening" in script)
        assert bench.engine.start_coordinator() is boot.coordinator
        assert boot.coordinator.said

    live(tmp_path, work)


class HeldBoot(Boot):
    """A boot that reads the output of the coordinator until it may end."""

    may_end = Event()
    has_read = False

    def _find_port(self) -> int:
        self.may_end.wait()
        self.has_read = True
        return 0


def test_two_threads_never_read_the_coordinator(tmp_path: Path) -> None:
    """Each would take lines from the other, and the port was lost."""

    async def work(bench: Bench) -> None:
        boot = booting(bench, kind=HeldBoot)
        assert bench.engine.start_coordinator() is boot.coordinator
        waiting = beside(bench.engine.wait_boot)
        assert not waiting.done()
        HeldBoot.may_end.set()
        waiting.result(20)
        assert isinstance(boot, HeldBoot) and boot.has_read

    live(tmp_path, work)


def test_the_daemon_is_told_its_coordinator_and_the_token(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.daemon(4711)
        given = environment(bench.paths.daemon, "daemon")
        assert (given["DORA_AUTH_TOKEN"], given["ADDED"]) == ("secret", "1")
        assert given["MODEL"] == "yolo"
        words = (bench.paths.daemon / "daemon.arguments").read_text().split()
        assert words[words.index("--coordinator-port") + 1] == "4711"
        access = json.loads(bench.paths.control.read_text())
        listen = int(words[words.index("--local-listen-port") + 1])
        assert access == {"port": 4711, "token": "secret", "local_listen_port": listen}
        assert stat.S_IMODE(bench.paths.control.stat().st_mode) == 0o600

    live(tmp_path, work)


def test_a_coordinator_without_a_token_is_an_error(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        with pytest.raises(FileNotFoundError):
            bench.engine.set_port(4711)

    live(tmp_path, work)


async def exits(child: engine.Child) -> tuple[str, Exit]:
    ended: asyncio.Future[tuple[str, Exit]] = asyncio.get_running_loop().create_future()
    engine.watch(asyncio.get_running_loop(), child, lambda *how: ended.set_result(how))
    return await ended


def test_the_daemon_is_asked_to_end_in_good_order(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        assert not bench.engine.dismiss_daemon(), "there is none"
        daemon = bench.daemon()
        assert bench.engine.dismiss_daemon()
        assert await exits(daemon) == ("daemon", exit_of(-2))
        assert not bench.engine.dismiss_daemon(), "it has left"

    live(tmp_path, work)


def test_what_is_left_of_the_two_is_killed_and_reaped(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        coordinator, daemon = bench.coordinator(), bench.daemon()
        bench.engine.kill()
        ends = [child.popen.wait(20) for child in (coordinator, daemon)]
        assert ends == [-signal.SIGKILL] * 2
        for child in (coordinator, daemon):
            with pytest.raises(OSError, match="Bad file descriptor"):
                os.fstat(child.pidfd)
        bench.engine.kill()

    live(tmp_path, work)


FORGOTTEN = "all daemons running this dataflow disconnected; waiting for daemon reconnect"


class Coordinator:
    """Speaks for dora's: each request gets the next of `answers`, and none waits for ever."""

    def __init__(self) -> None:
        self.answers: dict[str, list[Any]] = {}
        self.asked: list[str] = []
        self.params: list[Any] = []
        self.events: list[str] = []
        self.silent: set[str] = set()

    async def talk(self, socket: ServerConnection) -> None:
        async for text in socket:
            frame = json.loads(text)
            params = frame["params"]
            name = params if isinstance(params, str) else next(iter(params))
            self.asked.append(name)
            self.params.append(params)
            if name not in self.silent:
                result = self.answers[name].pop(0)
                await socket.send(json.dumps({"id": frame["id"], "result": result}))
            if name == "LogSubscribe":
                for message in self.events:
                    target, node = (
                        ("coordinator", None) if message == FORGOTTEN else ("daemon", "a")
                    )
                    payload = {"target": target, "node_id": node, "message": message}
                    await socket.send(json.dumps({"event": "log", "payload": payload}))
                return


def with_coordinator(
    root: Path, dora: Coordinator, work: Callable[[Engine], Coroutine[Any, Any, None]]
) -> None:
    async def both(bench: Bench) -> None:
        async with serve(dora.talk, "127.0.0.1", 0) as server:
            bench.daemon(next(iter(server.sockets)).getsockname()[1])
            await work(bench.engine)
            bench.engine.kill()

    live(root, both)


def test_the_daemon_is_waited_for(tmp_path: Path) -> None:
    dora = Coordinator()
    dora.answers["DaemonConnected"] = [{"DaemonConnected": one} for one in (False, False, True)]

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        assert dora.asked == ["DaemonConnected"] * 3

    with_coordinator(tmp_path, dora, work)


@pytest.mark.parametrize(("age", "silent"), [(19_000, ""), (21_000, "daemon"), (None, "")])
def test_a_daemon_that_was_not_heard_of_hangs(tmp_path: Path, age: int | None, silent: str) -> None:
    dora = Coordinator()
    dora.answers = {
        "DaemonConnected": [{"DaemonConnected": True}],
        "ConnectedMachines": [{"ConnectedDaemons": [{"last_heartbeat_ago_ms": age}]}],
    }

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        assert await engine.find_silent(10) == silent

    with_coordinator(tmp_path, dora, work)


def test_a_coordinator_that_does_not_answer_hangs(tmp_path: Path) -> None:
    dora = Coordinator()
    dora.answers["DaemonConnected"] = [{"DaemonConnected": True}]
    dora.silent = {"ConnectedMachines"}

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        assert await engine.find_silent(0.01) == "coordinator"

    with_coordinator(tmp_path, dora, work)


def test_a_run_and_its_events(tmp_path: Path) -> None:
    dora = Coordinator()
    dora.answers = {
        "DaemonConnected": [{"DaemonConnected": True}],
        "Start": [{"DataflowStartTriggered": {"uuid": RUN}}, {"Error": "no such node"}],
        "LogSubscribe": [{"subscribed": True}, {"Error": "unknown run"}],
    }
    dora.events = ["node is ready", "hello"]
    heard: list[LogRecord | None] = []

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        assert await engine.start_run({"nodes": []}, "robot") == RUN
        start = dora.params[-1]["Start"]
        assert (start["dataflow"], start["name"]) == ({"nodes": []}, "robot")
        assert start["local_working_dir"] == str(CellPaths(tmp_path).work)
        with pytest.raises(DoraSystemdError, match="no such node"):
            await engine.start_run({"nodes": []}, "robot")
        assert not await engine.read_events(RUN, lambda: heard.append(None), heard.append)
        first, *records = heard
        assert first is None, "it is told that it has begun, before anything comes"
        assert [one.message for one in records if one] == ["node is ready", "hello"]
        with pytest.raises(DoraSystemdError, match="cannot read events of dora: unknown run"):
            await engine.read_events(RUN, lambda: None, heard.append)

    with_coordinator(tmp_path, dora, work)


def test_a_run_that_the_coordinator_forgets(tmp_path: Path) -> None:
    dora = Coordinator()
    dora.answers = {
        "DaemonConnected": [{"DaemonConnected": True}],
        "LogSubscribe": [{"subscribed": True}],
    }
    dora.events = ["node is ready", FORGOTTEN, "not read"]
    heard: list[LogRecord] = []

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        assert await engine.read_events(RUN, lambda: None, heard.append), "the run goes on"
        assert [one.message for one in heard] == dora.events[:2]

    with_coordinator(tmp_path, dora, work)


def test_a_long_request_does_not_keep_the_others(tmp_path: Path) -> None:
    dora = Coordinator()
    dora.answers["DaemonConnected"] = [{"DaemonConnected": True}] * 2
    dora.silent = {"WaitForSpawn"}

    async def work(engine: Engine) -> None:
        await engine.wait_joined()
        long = asyncio.create_task(engine.ask_apart({"WaitForSpawn": {}}, 3600))
        while "WaitForSpawn" not in dora.asked:
            await asyncio.sleep(0.001)
        assert await engine.is_joined()
        assert not long.done()
        long.cancel()
        await settle()

    with_coordinator(tmp_path, dora, work)


def test_a_dora_that_is_gone_is_refused_and_not_tried_again(tmp_path: Path) -> None:
    paths = CellPaths(tmp_path)
    with pytest.raises(DoraSystemdError, match=r"^cannot run the dora command /nowhere") as caught:
        start_coordinator("/nowhere", paths, {})
    assert caught.value.code is ExitCode.NO_DORA
    (tmp_path / "dora").write_bytes(b"\0")  # found, and the kernel cannot execute it
    (tmp_path / "dora").chmod(0o755)
    with pytest.raises(OSError, match="Exec format error"):
        start_coordinator(str(tmp_path / "dora"), paths, {})

"""Changes of dora's log files: real inotify, and a loop that is woken once."""

import asyncio
from pathlib import Path

from dora_systemd.adapters.logs.jsonl import POLL_SECONDS, QUIET_POLLS
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.log_changes import LogChanges
from dora_systemd.runner.nodes.nodes import Nodes
from tests.unit.fakes.run import NoJournal


def test_the_first_change_after_each_watch_is_reported(tmp_path: Path) -> None:
    log = tmp_path / "log_a.jsonl"

    async def work() -> None:
        woken = asyncio.Queue[bool]()
        changes = LogChanges(tmp_path, lambda: woken.put_nowait(True))
        for _ in range(2):
            assert changes.watch()
            with log.open("a") as file:
                for _ in range(3):
                    file.write("line\n")
                    file.flush()
            async with asyncio.timeout(60):
                await woken.get()
            log.rename(tmp_path / "log_a.1.jsonl")
            await asyncio.sleep(0)
            assert woken.empty(), "what follows is found by polls"
        changes.close()
        changes.close()

    asyncio.run(work())


def test_what_came_before_wakes_nobody(tmp_path: Path) -> None:
    async def work() -> None:
        woken: list[bool] = []
        changes = LogChanges(tmp_path, lambda: woken.append(True))
        changes.watch()
        (tmp_path / "log_a.jsonl").write_text("line\n")
        changes.watch()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not woken
        changes.close()

    asyncio.run(work())


def test_a_directory_that_dora_has_not_made_yet(tmp_path: Path) -> None:
    async def work() -> None:
        changes = LogChanges(tmp_path / "out", lambda: None)
        assert not changes.watch()
        (tmp_path / "out").mkdir()
        assert changes.watch()
        changes.close()

    asyncio.run(work())


def test_a_node_whose_lines_dora_reads_rests_and_writes_again(tmp_path: Path) -> None:
    node = {"id": "a", "path": "a", "outputs": ["x"], "send_stdout_as": "x"}
    log = tmp_path / "work/out/run/log_a.jsonl"
    log.parent.mkdir(parents=True)
    (tmp_path / "io").mkdir()

    async def work() -> None:
        pipes = LogPipes(asyncio.get_running_loop(), NoJournal(), Origin("robot", "uuid"))
        nodes = Nodes(tmp_path, CellPaths(tmp_path), pipes)
        nodes.prepare(parse_dataflow({"nodes": [node]}, "dataflow.yml"), {}, ())
        nodes.listen("run")
        (follower,) = filter(None, nodes._tails.values())

        async def rests(expected: bool) -> None:
            async with asyncio.timeout(60):
                while follower.rests is not expected:
                    await asyncio.sleep(POLL_SECONDS)

        await rests(True)
        log.write_text('{"msg": "x"}\n')
        async with asyncio.timeout(60):
            while not pipes.line_counts().get("a"):
                await asyncio.sleep(0.01)
        await rests(False)
        nodes.close()

    asyncio.run(work())
    assert QUIET_POLLS * POLL_SECONDS <= 1

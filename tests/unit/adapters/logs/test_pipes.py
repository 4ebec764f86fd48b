"""The nodes' pipes, with real FIFOs and a socket of our own."""

import asyncio
import contextlib
import os
import socket
import stat
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path

from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.held import read_held
from dora_systemd.adapters.logs.pipes import DRAIN_LIMIT, LogPipes
from dora_systemd.adapters.logs.source import PIPE_SIZE, fifos
from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.decisions.resources.usage import WHOLE_CELL, LineCount
from dora_systemd.paths import CellPaths
from dora_systemd.values import SECOND

IDENTITY = Origin("robot", "550e8400-e29b-41d4-a716-446655440000")


class Cell:
    def __init__(self, root: Path) -> None:
        self.paths = CellPaths(root)
        self.paths.io.mkdir()
        self.server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.server.bind(str(root / "socket"))
        self.journal = JournalSocket(str(root / "socket"))
        self.pipes = LogPipes(asyncio.get_running_loop(), self.journal, IDENTITY)

    def node(self, name: str) -> None:
        self.pipes.make(name, self.paths)
        self.pipes.open(name)

    def write(self, path: Path, data: bytes) -> None:
        path.write_bytes(data)

    def received(self) -> list[dict[str, str]]:
        entries: list[dict[str, str]] = []
        while True:
            try:
                data = self.server.recv(1 << 20).decode()
            except BlockingIOError:
                return entries
            entries.append(dict(line.split("=", 1) for line in data.splitlines()))

    async def entries(self, count: int) -> list[dict[str, str]]:
        """Wait for so many entries."""
        found: list[dict[str, str]] = []
        async with asyncio.timeout(60):
            while len(found) < count:
                await asyncio.sleep(0)
                found += self.received()
        return found

    async def messages(self, count: int) -> list[str]:
        """The messages of so many entries."""
        return [entry["MESSAGE"] for entry in await self.entries(count)]

    async def until(self, condition: Callable[[], bool]) -> None:
        """Let the loop work until the condition holds."""
        async with asyncio.timeout(60):
            while not condition():
                await asyncio.sleep(0)


@asynccontextmanager
async def open_cell(root: Path) -> AsyncIterator[Cell]:
    cell = Cell(root)
    try:
        yield cell
    finally:
        cell.pipes.close(0.1)
        cell.journal.close()
        cell.server.close()


def run(root: Path, scenario: Callable[[Cell], Coroutine[None, None, None]]) -> None:
    async def main() -> None:
        async with open_cell(root) as cell:
            await scenario(cell)

    asyncio.run(main())


def test_lines_of_a_node(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("camera")
        assert stat.S_IMODE(cell.paths.node_stdout("camera").stat().st_mode) == 0o600
        cell.pipes.set_run("run1")
        cell.pipes.set_pid("camera", 42)
        cell.write(cell.paths.node_stdout("camera"), b"out\n")
        (out,) = await cell.entries(1)
        cell.write(cell.paths.node_stderr("camera"), b"err\n")
        (err,) = await cell.entries(1)
        assert (out["MESSAGE"], out["DORA_STREAM"], out["PRIORITY"]) == ("out", "stdout", "6")
        assert (err["MESSAGE"], err["DORA_STREAM"], err["PRIORITY"]) == ("err", "stderr", "5")
        assert out["DORA_RUN"] == "run1"
        assert out["DORA_NODE_PID"] == "42"
        assert out["SYSLOG_IDENTIFIER"] == "robot/camera"

    run(tmp_path, scenario)


def test_fifos_left_by_an_earlier_life_are_replaced(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.paths.node_stdout("a").write_text("left")
        cell.node("a")
        assert stat.S_ISFIFO(cell.paths.node_stdout("a").stat().st_mode)

    run(tmp_path, scenario)


def test_last_words_come_before_the_event(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.write(cell.paths.node_stderr("a"), b"Traceback\nValueError: half a line")
        cell.pipes.drain("a")
        cell.pipes.write_event("node-crashed", "a", exit="exit code 1")
        cell.pipes.write_event("dataflow-failed")
        entries = cell.received()
        assert [entry["MESSAGE"] for entry in entries] == [
            "Traceback",
            "ValueError: half a line",
            "Node a crashed: exit code 1",
            "Dataflow robot failed",
        ]
        assert entries[1]["DORA_CUT"] == "1"
        assert entries[2]["DORA_NODE"] == "a"
        assert entries[2]["DORA_EXIT"] == "exit code 1"
        assert entries[3]["SYSLOG_IDENTIFIER"] == "robot"

    run(tmp_path, scenario)


def test_a_line_is_whole_though_an_event_comes_in_the_middle_of_it(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.write(cell.paths.node_stdout("a"), b"before\none l")
        cell.pipes.drain("a", is_live=True)
        cell.pipes.write_event("node-ready", "a")
        cell.write(cell.paths.node_stdout("a"), b"ine\n")
        assert await cell.messages(3) == ["before", "Node a is ready", "one line"]

    run(tmp_path, scenario)


def test_a_limit_that_changes(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        path = cell.paths.node_stdout("a")
        for limit in (RateLimit(1, 60 * SECOND), None, RateLimit(2, 60 * SECOND)):
            cell.pipes.limit("a", limit)
            cell.pipes.limit("a", limit)  # changes nothing
            cell.write(path, b"1\n2\n3\n")
            cell.pipes.drain("a")
        cell.pipes.limit("unknown", None)
        assert [entry["MESSAGE"] for entry in cell.received()] == [
            *("1", "2 log lines of node a exceed its limit of 1/1min", "1", "2", "3"),
            *("1", "2", "1 log lines of node a exceed its limit of 2/1min"),
        ]
        assert list(cell.pipes.line_counts()) == ["", "a"]

    run(tmp_path, scenario)


def test_what_a_limit_takes_is_counted(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.pipes.limit("a", RateLimit(2, SECOND // 10))
        path = cell.paths.node_stdout("a")
        cell.write(path, b"1\n2\n3\n4\n")
        assert await cell.messages(3) == [
            "1",
            "2",
            "2 log lines of node a exceed its limit of 2/100ms",
        ]
        cell.write(path, b"5\n6\n7\n8")
        cell.write(cell.paths.node_stderr("a"), b"the last words")
        cell.pipes.drain("a")
        cell.pipes.write_fields({"MESSAGE": "from dora's file", "DORA_STREAM": "stdout"}, "a")
        cell.pipes.drain("a")
        cell.pipes.write_event("node-exited", "a")
        entries = cell.received()
        assert sorted(entry["MESSAGE"] for entry in entries[:3]) == ["5", "6", "the last words"]
        suppressed, more, exited = entries[3:]
        assert (suppressed["DORA_COUNT"], suppressed["DORA_NODE"]) == ("2", "a")
        assert more["DORA_COUNT"] == "1"
        assert suppressed["DORA_EVENT"] == "lines-suppressed"
        assert suppressed["DORA_LIMIT"] == "2/100ms"
        counts = cell.pipes.line_counts()
        assert counts == {"a": LineCount(5, 5), "": LineCount()}
        assert exited["MESSAGE"] == "Node a exited"

    run(tmp_path, scenario)


def test_flood_is_slowed_and_complete(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        data = b"".join(b"%d\n" % i for i in range(50_000))
        writer = asyncio.get_running_loop().run_in_executor(
            None, cell.write, cell.paths.node_stdout("a"), data
        )
        await asyncio.sleep(0.2)
        assert cell.pipes._queue.waiting("a") < 20_000
        cell.pipes.write_event("reloaded")
        messages = await cell.messages(50_001)
        await writer
        messages.remove("Dataflow robot was reloaded")
        assert messages == [str(i) for i in range(50_000)]

    run(tmp_path, scenario)


def test_quiet_node_passes_a_flood(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("flood")
        cell.node("quiet")
        flood = os.open(cell.paths.node_stdout("flood"), os.O_WRONLY | os.O_NONBLOCK)
        os.write(flood, b"x\n" * 20_000)
        await asyncio.sleep(0.1)
        # As many entries as the kernel lets wait (10, or 512 under systemd), then one at a time.
        cell.write(cell.paths.node_stdout("quiet"), b"quiet\n")
        messages = await cell.messages(1000)
        assert "quiet" in messages
        os.close(flood)
        await cell.messages(20_001 - len(messages))

    run(tmp_path, scenario)


def test_wait_until_journald_has_taken_all(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.write(cell.paths.node_stdout("a"), b"x\n" * 5000)
        cell.pipes.drain("a")
        await cell.pipes.wait_empty(iter([0.1, 0.1, 0.0]).__next__)
        assert cell.pipes.is_busy("a")
        reader = asyncio.create_task(cell.messages(5000))
        await cell.pipes.wait_empty(lambda: 1.0)
        assert not cell.pipes.is_busy("a")
        assert len(await reader) == 5000

    run(tmp_path, scenario)


def test_journald_restarted(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        path = cell.paths.node_stdout("a")
        cell.write(path, b"1\n")
        assert await cell.messages(1) == ["1"]
        cell.server.close()
        (tmp_path / "socket").unlink()
        cell.write(path, b"2\n3\n")
        await cell.until(lambda: cell.pipes.is_busy("a"))
        cell.write(path, b"4\n")
        cell.server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        cell.server.bind(str(tmp_path / "socket"))
        assert await cell.messages(3) == ["2", "3", "4"]

    run(tmp_path, scenario)


def test_what_journald_has_not_taken_outlives_the_runner(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        path = cell.paths.node_stdout("a")
        cell.server.close()
        (tmp_path / "socket").unlink()
        cell.write(path, b"1\n2\n")
        await cell.until(lambda: cell.pipes.is_busy("a"))
        assert read_held(path) == (b"1\n2\n", 0)

    run(tmp_path, scenario)


def test_output_of_the_coordinator(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        reader, writer = os.pipe()
        lines: list[str] = []
        cell.pipes.add_output("coordinator", reader, lines.append)
        os.write(writer, b"2026-11-20T22:11:40.6Z  INFO dora_coordinator: SECRET\nListening on ")
        os.write(writer, b"port 33453\n2026-11-20T22:11:40.6Z ERROR dora_coordinator: bad\n")
        os.close(writer)
        (entry,) = await cell.entries(1)
        assert lines[1] == "Listening on port 33453"
        assert entry["MESSAGE"] == "dora_coordinator: bad"
        assert entry["DORA_NODE"] == "coordinator"
        assert entry["PRIORITY"] == "3"
        await cell.until(lambda: not Path(f"/proc/self/fd/{reader}").exists())

    run(tmp_path, scenario)


def test_output_that_was_read_before_comes_first(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        reader, writer = os.pipe()
        lines: list[str] = []
        os.write(writer, b" WARN dora: b\nc\n")
        said = b"Listening on port 1\n2026-11-20T22:11:40.6Z"
        cell.pipes.add_output("coordinator", reader, lines.append, said)
        assert not lines, "it is read in the loop"
        (entry,) = await cell.entries(1)
        assert entry["MESSAGE"] == "dora: b"
        assert lines == ["Listening on port 1", "2026-11-20T22:11:40.6Z WARN dora: b", "c"]
        os.close(writer)

    run(tmp_path, scenario)


def test_output_is_read_at_once_if_it_explains_something(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        (reader, writer), lines = os.pipe(), list[str]()
        cell.pipes.read_output("daemon")
        cell.pipes.add_output("daemon", reader, lines.append)
        os.set_blocking(writer, False)
        printed = os.write(writer, b"a line\n" * 10_000)
        cell.pipes.read_output("daemon")
        assert len(lines) == printed // len("a line\n"), "all that a pipe can have"
        cell.pipes.read_output("daemon")
        os.write(writer, b"rest")
        os.close(writer)
        cell.pipes.read_output("daemon")
        assert lines[-1].endswith("rest")
        other, writer = os.pipe()
        assert other == reader, "closed at the end"
        cell.pipes.add_output("coordinator", other)
        cell.pipes.read_output("daemon")
        os.close(writer)

    run(tmp_path, scenario)


def test_close_counts_what_it_cannot_write(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.server.close()
        (tmp_path / "socket").unlink()
        cell.write(cell.paths.node_stdout("a"), b"1\n2\n")
        cell.pipes.drain("a")
        cell.server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        cell.server.bind(str(tmp_path / "socket"))  # journald is back, and no time is left
        cell.pipes.close(0.0)
        (entry,) = cell.received()
        assert (entry["DORA_EVENT"], entry["DORA_COUNT"]) == ("lines-lost", "2")
        assert cell.pipes.line_counts()[WHOLE_CELL] == LineCount(lost=2)
        assert entry["DORA_REASON"] == "journald did not take them"

    run(tmp_path, scenario)


def test_what_systemd_keeps_of_a_node_goes_with_it(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        kept: list[str] = []
        pipes = LogPipes(
            asyncio.get_running_loop(),
            cell.journal,
            IDENTITY,
            lambda _, node: kept.append(node),
            kept.remove,
        )
        for node in ("a", "b"):
            pipes.make(node, cell.paths)
        pipes.open("a")
        pipes.forget("b")  # never opened
        assert kept == ["a", "a"]
        pipes.forget("a")
        assert kept == ["a"], "released by name, once"
        pipes.close(0.1)

    run(tmp_path, scenario)


def test_nothing_stays_of_a_node_that_does_not_come_back(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.node("b")
        path = cell.paths.node_stdout("a")
        cell.write(path, b"last")
        cell.pipes.forget("a")
        assert await cell.messages(1) == ["last"]
        assert {one.name.split(".")[0] for one in path.parent.iterdir()} == {
            one.name.split(".")[0] for one in fifos("b", cell.paths).values()
        }
        assert list(cell.pipes.line_counts()) == ["", "b"]
        cell.node("a")
        cell.write(path, b"again\n")
        assert await cell.messages(1) == ["again"]

    run(tmp_path, scenario)


def test_whose_end_was_asked_for_is_not_told_by_the_daemon(tmp_path: Path) -> None:
    line = "2026-11-20T22:11:40.6Z ERROR run: node_failure: dora_daemon::x: bad node_id={} x\n"

    async def scenario(cell: Cell) -> None:
        reader, writer = os.pipe()
        cell.pipes.add_output("daemon", reader)
        cell.pipes.write_event("node-asked", "a", asked="stop", by="eve")
        assert await cell.messages(1) == ["Node a: stop requested by eve"]
        os.write(writer, line.format("a").encode() + line.format("b").encode())
        (entry,) = await cell.entries(1)
        assert "node_id=b" in entry["MESSAGE"]
        cell.pipes.write_event("node-ready", "a")
        os.write(writer, line.format("a").encode())
        messages = await cell.messages(2)
        assert "node_id=a" in messages[1]
        cell.pipes.expect_ends("zzz-")
        os.write(writer, line.format("zzz-1").encode() + line.format("c").encode())
        (entry,) = await cell.entries(1)
        assert "node_id=c" in entry["MESSAGE"]
        os.close(writer)

    run(tmp_path, scenario)


def test_which_lines_of_children_are_no_records(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        outputs = {label: os.pipe() for label in ("daemon", "coordinator")}
        lines: list[str] = []
        for label, (reader, _) in outputs.items():
            cell.pipes.add_output(label, reader, lines.append)
        cell.pipes.mute("daemon")
        cell.pipes.left_out = (b"known",)
        for _, writer in outputs.values():
            os.write(writer, b"2026-11-20T22:11:40.6Z ERROR a known one\n")
            os.write(writer, b"2026-11-20T22:11:40.6Z ERROR another\n")
        (entry,) = await cell.entries(1)
        assert (entry["DORA_NODE"], entry["MESSAGE"]) == ("coordinator", "another")
        await cell.until(lambda: len(lines) == 4)
        cell.pipes.mute()
        os.write(outputs["daemon"][1], b"2026-11-20T22:11:40.6Z ERROR late")
        for _, writer in outputs.values():
            os.close(writer)
        (entry,) = await cell.entries(1)
        assert (entry["DORA_NODE"], entry["MESSAGE"]) == ("daemon", "late")

    run(tmp_path, scenario)


def test_the_process_of_a_line_is_known_before_dora_tells_it(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.paths.node_pid("a").write_text("4711\n")
        cell.write(cell.paths.node_stdout("a"), b"1\n")
        (entry,) = await cell.entries(1)
        assert entry["DORA_NODE_PID"] == "4711"
        cell.paths.node_pid("a").write_text("no number")
        cell.pipes.set_pid("a", 0)
        cell.write(cell.paths.node_stdout("a"), b"2\n")
        (entry,) = await cell.entries(1)
        assert (entry["MESSAGE"], entry.get("DORA_NODE_PID")) == ("2", None)

    run(tmp_path, scenario)


def test_a_drain_reads_no_more_than_it_may_keep(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        cell.node("a")
        cell.server.close()
        (tmp_path / "socket").unlink()
        fd, written = os.open(cell.paths.node_stdout("a"), os.O_WRONLY | os.O_NONBLOCK), 0
        with contextlib.suppress(BlockingIOError):  # the rest stays in the pipe
            for _ in range(99):
                written += os.write(fd, b"x\n" * 4096)
                cell.pipes.drain("a", is_live=True)
        assert DRAIN_LIMIT <= written <= DRAIN_LIMIT + 2 * PIPE_SIZE
        os.close(fd)

    run(tmp_path, scenario)


def flood_without_journald(cell: Cell, root: Path, count: int) -> int:
    """Fill the pipe and drain it, with journald away; returns the number of lines of 15 bytes."""
    cell.node("a")
    cell.server.close()
    (root / "socket").unlink()
    fd, numbers = os.open(cell.paths.node_stdout("a"), os.O_WRONLY | os.O_NONBLOCK), 0
    with contextlib.suppress(BlockingIOError):  # so many bytes fit into the pipe
        while numbers < count:
            os.write(fd, b"".join(b"%08d flood\n" % (numbers + one) for one in range(250)))
            numbers += 250
            if not numbers % 1000:  # more than a drain reads at once
                cell.pipes.drain("a")
    os.close(fd)
    return numbers


def bind_journald(cell: Cell, root: Path) -> None:
    cell.server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    cell.server.bind(str(root / "socket"))


def test_a_drain_that_reaches_its_limit_ends_no_line(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        numbers = flood_without_journald(cell, tmp_path, 99_999)
        cell.pipes.drain("a")
        bind_journald(cell, tmp_path)
        assert await cell.messages(numbers) == [f"{one:08d} flood" for one in range(numbers)]

    run(tmp_path, scenario)


def test_a_pipe_that_is_removed_is_read_beyond_the_limit(tmp_path: Path) -> None:
    async def scenario(cell: Cell) -> None:
        numbers = flood_without_journald(cell, tmp_path, 99_999)
        cell.pipes.forget("a")
        bind_journald(cell, tmp_path)
        assert await cell.messages(numbers) == [f"{one:08d} flood" for one in range(numbers)]

    run(tmp_path, scenario)

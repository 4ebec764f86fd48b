"""What becomes of lines and events while journald takes none, and when it takes them again."""

import asyncio
import os
from pathlib import Path

from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.logs.queue import MAX_RECORDS
from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.decisions.resources.usage import WHOLE_CELL, LineCount
from dora_systemd.values import SECOND
from tests.unit.adapters.logs.test_queue import SlowJournal

IDENTITY = Origin("robot", "550e8400-e29b-41d4-a716-446655440000")


class Slow(SlowJournal):
    """Has no room but for one entry each time that somebody waits for it; waits: how long."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float] = []

    def wait_ready(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.room += 1


def entry_texts(journal: SlowJournal) -> list[str]:
    return [one.decode().split("MESSAGE=", 1)[1].split("\n", 1)[0] for one in journal.taken]


def turn(loop: asyncio.AbstractEventLoop) -> None:
    """Let the loop read what there is, once."""
    loop.call_soon(loop.stop)
    loop.run_forever()


def fifo_of(path: Path, data: bytes) -> int:
    os.mkfifo(path)
    fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    os.write(fd, data)
    return fd


def test_the_other_pipe_of_a_node_that_waits_is_not_read(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    """Or the lines of a node would pile up here while journald is away."""
    journal = SlowJournal()
    pipes = LogPipes(loop, journal, IDENTITY)
    out, err = fifo_of(tmp_path / "out", b"1\n"), fifo_of(tmp_path / "err", b"2\n")
    pipes.adopt("a", "stdout", out)
    turn(loop)
    pipes.adopt("a", "stderr", err)
    turn(loop)
    assert os.read(err, 10) == b"2\n", "it is in the pipe"
    os.write(err, b"3\n")
    os.write(out, b"4\n")
    turn(loop)
    assert (os.read(err, 10), os.read(out, 10)) == (b"3\n", b"4\n")
    journal.make_room(9)
    os.write(err, b"5\n")
    turn(loop)
    assert entry_texts(journal) == ["1", "5"]
    pipes.close(0.0)


def test_to_close_waits_for_journald_no_longer_than_it_may(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    journal = Slow()
    pipes = LogPipes(loop, journal, IDENTITY)
    pipes.adopt("a", "stdout", fifo_of(tmp_path / "out", b"1\n2\n3\n"))
    pipes.close(1000.0)
    assert entry_texts(journal) == ["1", "2", "3"]
    first, second, third = journal.waits
    assert 1000 >= first >= second >= third > 900


def test_records_that_are_lost_are_reported_when_journald_is_back(
    loop: asyncio.AbstractEventLoop,
) -> None:
    journal = SlowJournal()
    pipes = LogPipes(loop, journal, IDENTITY)
    for _ in range(MAX_RECORDS + 3):
        pipes.write_event("node-ready", "a")
    journal.make_room(MAX_RECORDS + 1)
    fields = dict(line.split("=", 1) for line in journal.taken[-1].decode().splitlines())
    assert fields["MESSAGE"] == (
        "3 log lines of dataflow robot are lost: journald was away for too long"
    )
    assert (fields["DORA_EVENT"], fields["DORA_COUNT"]) == ("lines-lost", "3")
    assert pipes.line_counts()[WHOLE_CELL] == LineCount(lost=3)
    pipes.close(0.0)


def test_what_an_event_of_the_dataflow_has(loop: asyncio.AbstractEventLoop) -> None:
    journal = SlowJournal()
    journal.room = 9
    pipes = LogPipes(loop, journal, IDENTITY)
    pipes.write_event("node-ready", "a")
    pipes.set_run("run1")
    pipes.set_pid("a", 7)
    pipes.write_event("node-ready", "a")
    pipes.write_event("dataflow-failed", reason="x")
    lines = [one.decode().splitlines() for one in journal.taken]
    first, later, whole = (dict(line.split("=", 1) for line in one) for one in lines)
    own = {"DORA_DATAFLOW": IDENTITY.uuid, "DORA_DATAFLOW_NAME": "robot"}
    of_node = {**own, "SYSLOG_IDENTIFIER": "robot/a", "DORA_NODE": "a"}
    assert first.items() >= of_node.items()
    assert not {"DORA_RUN", "DORA_NODE_PID"} & first.keys()
    assert later.items() >= {**of_node, "DORA_RUN": "run1", "DORA_NODE_PID": "7"}.items()
    assert whole.items() >= {**own, "SYSLOG_IDENTIFIER": "robot", "DORA_RUN": "run1"}.items()
    assert not {"DORA_NODE", "DORA_NODE_PID"} & whole.keys()
    assert whole["MESSAGE"] == "Dataflow robot failed: x"
    pipes.close(0.0)


def test_each_stream_has_a_limit_of_its_own(loop: asyncio.AbstractEventLoop) -> None:
    """Also of a node whose lines come from dora's own log file."""
    journal = SlowJournal()
    journal.room = 99
    pipes = LogPipes(loop, journal, IDENTITY)
    pipes.limit("a", RateLimit(1, 60 * SECOND))
    for text, stream in (("1", "stdout"), ("2", "stderr"), ("3", "stdout"), ("4", "stderr")):
        pipes.write_fields({"MESSAGE": text, "DORA_STREAM": stream}, "a")
    pipes.write_fields({"MESSAGE": "5"}, "a")
    pipes.drain("a")
    suppressed = "3 log lines of node a exceed its limit of 1/1min"
    assert entry_texts(journal) == ["1", "2", suppressed]
    assert pipes.line_counts()["a"] == LineCount(2, 3)
    pipes.close(0.0)

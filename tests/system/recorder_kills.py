"""kill -9 of recorder, node, daemon and runner, and which messages a bundle has then.

By hand: make kills ROUNDS=500, or in the lab: python -m tests.system.recorder_kills ROUNDS [SEED].
"""

import io
import os
import random
import signal
import struct
import sys
import tarfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.recorder.mcap import OUTPUT, RUN
from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.verbs.bundles.write import write_bundle
from tests.lab.pace import pace
from tests.system.cells import Cell, Project, wait_for
from tests.system.test_record import Ring, has_more, start
from tests.unit.fakes.recorder.mcap import File

# The messages of both outputs have the number of the round of the node and their own.
CAMERA = """
import time
from dora import Node
import pyarrow as pa
node, life, at = Node(), time.time_ns(), 0
for event in node:
    if event["type"] == "INPUT":
        at += 1
        node.send_output("image", pa.array([at] * 50_000, type=pa.int64()), {"width": 5})
        node.send_output("count", pa.array([life, at], type=pa.int64()))
"""
SINK = """
import os, struct
from dora import Node
file = os.open("received", os.O_WRONLY)
for event in Node():
    if event["type"] == "INPUT":
        os.pwrite(file, struct.pack("<qq", *event["value"].to_pylist()), 0)
"""
FLOW = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}, outputs: [image, count]}
  - {id: sink, path: sink.py, inputs: {count: camera/count}}
"""
RECORD = "memory=8M,outputs=camera/image+camera/count"
RESTARTS = (
    *("--restart-policy", "on-failure", "--max-restarts", "100000"),
    *("--restart-delay", "500ms", "--max-restart-delay", "500ms"),
)
WHO = ("recorder", "node", "daemon", "runner")
HEADER = ("KILLED", "ROUNDS", "WRONG", "LAST MISSING", "BEHIND A NODE", "AT MOST")


class Round(NamedTuple):
    """What a bundle lacked after a kill."""

    who: str
    missing: int  # messages that the recorder had received
    behind: int  # messages that the node `sink` had received and the bundle lacks
    wrong: tuple[str, ...]

    def __str__(self) -> str:
        verdict = "; ".join(self.wrong) or "ok"
        return f"{self.who}: missing {self.missing}, behind {self.behind}: {verdict}"


class Found(NamedTuple):
    """What a recording has. lives: the last number of each life of the camera."""

    last: int
    received: int
    damaged: int
    lives: dict[int, int]


def read_strictly(data: bytes) -> Found:
    """Read a recording with all its CRCs, by the library mcap and by the reader of our tests.

    Raises the exceptions of these if anything is wrong.
    """
    assert sum(1 for _ in StreamReader(io.BytesIO(data), validate_crcs=True).records)
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    summary, messages = reader.get_summary(), list(reader.iter_messages())
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages) == len(File(data).messages)
    facts = [(one.name, one.metadata) for one in reader.iter_metadata()]
    received = sum(int(one["received"]) for name, one in facts if name == OUTPUT)
    damaged = sum(int(one["damaged"]) for name, one in facts if name == RUN)
    lives = dict(
        sorted(
            _count(schema.data, message.data)
            for schema, channel, message in messages
            if schema is not None and channel.topic == "camera/count"
        )
    )
    last = max(message.sequence for _, _, message in messages)
    return Found(last, received, damaged, lives)


def _count(schema: bytes, data: bytes) -> tuple[int, int]:
    """The life of the camera and the number of a message."""
    names = pa.ipc.read_schema(pa.py_buffer(schema))
    life, at = pa.ipc.read_record_batch(pa.py_buffer(data), names).column("value").to_pylist()
    return life, at


class Scene:
    """A dataflow with a camera, a node that receives its messages, and a recorder."""

    def __init__(self, cell: Cell, project: Project, chance: random.Random) -> None:
        self.cell, self.project, self.chance = cell, project, chance
        self.data = b""  # the newest recording
        self._last = self._lost = 0

    def begin(self) -> None:
        """Start it."""
        for name, text in (("camera.py", CAMERA), ("sink.py", SINK), ("received", "")):
            self.project.write(name, text)
        self.project.root.joinpath("received").chmod(0o666)
        flow = self.project.write("flow.yml", FLOW)
        place = ("--writable", str(self.project.root))
        start(self.cell, flow, "--record", RECORD, *place, *RESTARTS)

    def kill(self, who: str) -> Round:
        """Kill one of its processes at some moment, and look what a bundle has."""
        more = self._last + self.chance.randrange(10, 40)
        wait_for("it records", partial(has_more, more), 120)
        pid = wait_for("it runs", lambda: victim(self.cell, who))
        time.sleep(self.chance.uniform(0, 0.04))  # the moment is what is tried
        before = Ring().last()
        os.kill(pid, signal.SIGKILL)
        seen = self._seen()
        try:
            self.data, errors = self._bundle()
            found = read_strictly(self.data)
        except Exception as error:  # that is what is tried
            return Round(who, 0, 0, (f"{type(error).__name__}: {error}",))
        # The counters are those of all lives: what earlier kills have cost stays missing.
        lost = found.received - found.last
        missing, self._lost, self._last = lost - self._lost, max(lost, self._lost), found.last
        behind, wrong = _behind(found, seen), _wrong(found, before, missing)
        return Round(who, max(missing, 0), behind, (*errors, *wrong))

    def _seen(self) -> tuple[int, int]:
        """The last message that the other node has received."""
        data = (self.project.root / "received").read_bytes()
        life, at = struct.unpack("<qq", data) if data else (0, 0)
        return life, at

    def _bundle(self) -> tuple[bytes, tuple[str, ...]]:
        file = self.project.root.parent / "kill.tar"
        done = write_bundle(Bus, self.cell.scope, self.cell.name, "a test", file)
        with tarfile.open(file) as archive:
            part = archive.extractfile("recording.mcap")
            assert part is not None
            return part.read(), done.errors


def _behind(found: Found, seen: tuple[int, int]) -> int:
    life, at = seen
    newest = max(found.lives, default=0)
    return max(at - found.lives.get(life, 0), 0) if newest <= life else 0


def _wrong(found: Found, before: int, missing: int) -> Iterator[str]:
    if found.last < before:
        yield f"message {found.last} is the last, and {before} was recorded before the kill"
    if missing > 1:
        yield f"{missing} messages that were received are missing"
    if found.damaged:
        yield f"{found.damaged} damaged messages"


def victim(cell: Cell, who: str) -> int:
    """The process to kill, 0 if it does not run."""
    if who == "recorder":
        return next(iter(cell.pids("node-dora-systemd-recorder")), 0)
    if who == "node":
        return cell.status.nodes["camera"].pid
    with suppress(AssertionError):  # there is none between two lives
        return cell.supervisor_pid(who)
    return 0


def table(rounds: Sequence[Round]) -> str:
    """All rounds, by what was killed."""
    kinds = [(who, [one for one in rounds if one.who == who]) for who in WHO]
    return format_table(HEADER, [_row(*one) for one in [*kinds, ("all", rounds)]])


def _row(who: str, rounds: Sequence[Round]) -> list[str]:
    wrong, missing = sum(bool(one.wrong) for one in rounds), sum(one.missing for one in rounds)
    behind = [one.behind for one in rounds]
    late = sum(one > 1 for one in behind)
    return [who, *map(str, (len(rounds), wrong, missing, late, max(behind, default=0)))]


def main(count: int, seed: int) -> int:
    """Make so many kills in a dataflow of their own; 1 if a bundle was not as it must be."""
    root = Path("/var/tmp/recorder-kills")
    root.mkdir()
    cell, rounds = Cell("kills"), list[Round]()
    scene = Scene(cell, Project(root / "project"), random.Random(seed))
    try:
        scene.begin()
        print(f"seed {seed}; pace {pace():.1f}", flush=True)
        for number in range(count):
            rounds.append(scene.kill(WHO[number % len(WHO)]))
            print(number + 1, rounds[-1], flush=True)
    finally:
        print(table(rounds), flush=True)
        cell.end()
    return int(any(one.wrong for one in rounds))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1))

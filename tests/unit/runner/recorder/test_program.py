"""runner/recorder/record.py: the real program, with a dora and a pyarrow of the test."""

import asyncio
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import dora_systemd
from dora_systemd.decisions.recorder.reading import Reading, Recorded
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.runner.recorder.keep import RingSocket, fitted_ring, header_of
from dora_systemd.runner.recorder.record import NICE, has_weight

PACKAGE = Path(dora_systemd.__file__).parent
SCRIPT = PACKAGE / "runner" / "recorder" / "record.py"
DORA = """
import datetime, os, threading

def policies():
    return [os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")]

BEFORE = policies()
SENT = datetime.datetime(2026, 11, 27, tzinfo=datetime.timezone.utc)
EVENTS = [{events}]

class Node:
    def __init__(self):
        threading.Thread(target=threading.Event().wait, daemon=True).start()

    def next(self):
        event = EVENTS.pop(0)
        if callable(event):
            return event()
        if isinstance(event, bytes):
            os.write(1, event)
            return {{"type": "NODE_RESTARTED"}}
        return event
"""
ARROW = """
class types:
    is_dictionary = staticmethod(lambda kind: kind == "dictionary")

class Text:
    def __init__(self, text): self.text = text
    def to_pybytes(self): return self.text.encode()

class Schema:
    def __init__(self, kind): self.kind = kind
    def equals(self, other, check_metadata): return self.kind == other.kind
    def serialize(self): return Text("schema of " + self.kind)

class Value:
    def __init__(self, kind, data): self.type, self.data = kind, data
    def dictionary_decode(self): return Value("text", b"decoded " + self.data)

class RecordBatch:
    def __init__(self, value): self.value, self.schema = value, Schema(value.type)
    def serialize(self): return self.value.data

    @staticmethod
    def from_arrays(values, names):
        assert names == ["value"]
        return RecordBatch(*values)
"""


def event(output: int, data: bytes, kind: str = "uint8", metadata: str = "{}") -> str:
    value = f"__import__('pyarrow').Value({kind!r}, {data!r})"
    return f'{{"type": "INPUT", "id": "{output}", "value": {value}, "metadata": {metadata}}}'


def recorded(place: Path, *events: str) -> tuple[list[Recorded], Reading]:
    """What it has recorded when it has ended."""
    (place / "dora.py").write_text(DORA.format(events=", ".join(events)))
    (place / "pyarrow.py").write_text(ARROW)
    header = header_of(Record(outputs=("a/x", "a/y")), ("a/x", "a/y"), {})
    ring = fitted_ring(-1, header)
    loop = asyncio.new_event_loop()

    async def serve() -> None:
        socket = RingSocket(place / "ring.sock", ring)
        try:
            await loop.run_in_executor(None, run)
        finally:
            socket.close()

    def run() -> None:
        subprocess.run(
            [sys.executable, str(SCRIPT), str(place / "ring.sock"), str(PACKAGE)],
            env={"PYTHONPATH": str(place)},
            check=True,
            timeout=120,
        )

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    thread.join()
    loop.close()

    class Source:
        def read(self, at: int, size: int) -> bytes:
            return os.pread(ring, size, at)

    reading = Reading(Source(), os.fstat(ring).st_size, 1 << 30)
    messages = list(reading.messages())
    os.close(ring)
    return messages, reading


STOP = '{"type": "STOP"}'


def test_messages_are_copied(tmp_path: Path) -> None:
    metadata = '{"timestamp": SENT, "width": 3, "odd": {1, 2}}'
    messages, _ = recorded(
        *(tmp_path, event(1, b"one", metadata=metadata), event(0, b"two")),
        *(event(1, b"three", "dictionary"), STOP, event(0, b"never")),
    )
    assert [(one.output, one.schema, one.data) for one in messages] == [
        (1, b"schema of uint8", b"one"),
        (0, b"schema of uint8", b"two"),
        (1, b"schema of text", b"decoded three"),
    ]
    assert messages[0].meta == b'{"width": 3, "odd": "{1, 2}"}'
    assert messages[0].head.sent_ns == 1_795_737_600_000_000_000
    assert (messages[1].meta, messages[1].head.sent_ns) == (b"{}", 0)
    assert messages[1].head.received_ns > messages[0].head.received_ns > 0


def test_what_dora_drops_is_counted(tmp_path: Path) -> None:
    line = b"WARN Discarding event for input `%d` due to queue size limit\n"
    events = (repr(line % 1), repr(line % 1 + line % 0), repr(b"Discarding event"), event(1, b"x"))
    _, reading = recorded(tmp_path, *events, STOP)
    assert [one.dropped for one in reading.states] == [0, 2]


def test_all_threads_give_way_once_it_is_connected(tmp_path: Path) -> None:
    metadata = '{"before": BEFORE, "now": policies()}'
    (message,), _ = recorded(tmp_path, f"lambda: {event(0, b'x', metadata=metadata)}", STOP)
    usual = os.sched_getscheduler(0)
    now = os.SCHED_IDLE if has_weight() else os.SCHED_BATCH
    assert json.loads(message.meta) == {"before": [usual], "now": [now, now]}


@pytest.mark.parametrize("is_idle", [True, False])
def test_a_process_without_a_weight_is_not_idle(is_idle: bool) -> None:
    names = "dora_systemd.runner.recorder.record import NICE, give_way"
    now = "os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)"
    code = f"import os\nfrom {names}\ngive_way({is_idle})\nprint({now}, NICE)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    given = (os.SCHED_IDLE, nice) if is_idle else (os.SCHED_BATCH, max(nice, NICE))
    assert done.stdout == f"{given[0]} {given[1]} {NICE}\n"


def test_a_weight_is_that_of_the_own_cgroup(tmp_path: Path) -> None:
    own, groups = tmp_path / "cgroup", tmp_path / "groups"
    assert not has_weight(str(own), str(groups))
    (groups / "a/b").mkdir(parents=True)
    (groups / "a/cpu.weight").touch()
    for text, expected in (
        *(("0::/a/b\n", False), ("0::/a\n", True), ("5:cpu:/a\n", False)),
        ("5:cpu:/x\n0::/a\n", True),
    ):
        own.write_text(text)
        assert has_weight(str(own), str(groups)) == expected, text


def test_it_ends_with_an_input(tmp_path: Path) -> None:
    messages, _ = recorded(tmp_path, '{"type": "INPUT_CLOSED", "id": "1"}', event(0, b"never"))
    assert messages == []

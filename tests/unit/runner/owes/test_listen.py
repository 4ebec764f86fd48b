"""runner/owes/listen.py: the real program, with a dora that hands it what the test wants."""

import struct
import subprocess
import sys
from pathlib import Path

import dora_systemd

SCRIPT = Path(dora_systemd.__file__).parent / "runner" / "owes" / "listen.py"
DORA = """
import time
import pyarrow
assert pyarrow.Array._import_from_c(1, 2) is None

EVENTS = [{events}]

class Node:
    def next(self, timeout):
        if not EVENTS:
            time.sleep(60)
        event = EVENTS.pop(0)
        if event == "timeout":
            time.sleep(timeout)
            return {{"type": "ERROR", "error": "Receiver timed out"}}
        return event
"""
IMAGE = '{"type": "INPUT", "id": "1", "value": None}'


def probe(place: Path, events: str) -> list[int]:
    """What it has noted when it has ended."""
    (place / "dora.py").write_text(DORA.format(events=events))
    times = place / "times"
    times.write_bytes(bytes(8 * 4))
    subprocess.run(
        [sys.executable, str(SCRIPT), str(times), "0.05"],
        env={"PYTHONPATH": str(place)},
        check=True,
        timeout=120,
    )
    return list(struct.unpack("=4Q", times.read_bytes()))


def test_beats_and_messages_are_noted(tmp_path: Path) -> None:
    beat, *heard = probe(tmp_path, f'"timeout", {IMAGE}, "timeout", {{"type": "STOP"}}')
    assert beat > heard[1] > 0
    assert (heard[0], heard[2]) == (0, 0)


def test_it_ends_with_an_input_and_hears_none_before(tmp_path: Path) -> None:
    closed = '{"type": "INPUT_CLOSED", "id": "1"}'
    beat, *heard = probe(tmp_path, f'{{"type": "NODE_RESTARTED"}}, None, {closed}, {IMAGE}')
    assert beat > 0
    assert heard == [0, 0, 0]

"""Latency and throughput between two nodes, 8 B to 4 MB.  `python -m benchmarks.messages [N]`

The pattern is that of dora's own benchmark: for each size some messages at intervals, for the
latency, then as many as fast as they go. Some are sent before, while the nodes find each other.

A life differs by a tenth from the next one, whoever supervises it, so a difference of some percent
needs many lives in turns: the report gives the interval of confidence. `dora up` arranges its
processes as ours does. `dora run` has the daemon in another thread of its process, so that a
message wakes one thread less.
"""

import json
import statistics
import sys
from functools import partial

from benchmarks.contestants import Contestant, Doractl, DoraRunOfUser, DoraUpOfUser, prepared
from benchmarks.flows import STAMP, STAMPS, clear_stamps, make_home, wait_gone, wait_stamps
from benchmarks.rounds import Figure, keep, shown, take_turns

SIZES = (8, 4096, 40_960, 4_096_000)
COUNT = 200
PAUSE = 0.005
RESULT = STAMPS / "messages.json"
SENDER = f"""
import time
from dora import Node
import os, pyarrow
node = Node()
time.sleep(0.5)
for number in range({COUNT}):
    node.send_output("data", pyarrow.array([1] * 3), {{"is_fast": 0, "sent": 0}})
    time.sleep({PAUSE})
for size in {SIZES}:
    buffers = [None, pyarrow.py_buffer(os.urandom(size))]
    data = pyarrow.Array.from_buffers(pyarrow.uint8(), size, buffers)
    for pause in ({PAUSE}, 0):
        for number in range({COUNT}):
            about = {{"is_fast": int(not pause), "sent": time.monotonic_ns()}}
            node.send_output("data", data, about)
            time.sleep(pause)
        time.sleep(0.3)
"""
RECEIVER = f"""{STAMP}
import json
import pyarrow
node, found = Node(), []
for event in node:
    if event["type"] == "INPUT":
        now, about = time.monotonic_ns(), event["metadata"]
        found.append((len(event["value"]), about["is_fast"], about["sent"], now))
with open("{RESULT}", "w") as file:
    json.dump(found, file)
stamp("messages")
"""
YAML = f"""nodes:
  - {{id: sender, path: sender.py, outputs: [data]}}
  - id: receiver
    path: receiver.py
    inputs: {{data: {{source: sender/data, queue_size: {2 * COUNT}}}}}
"""
Message = tuple[int, int, int, int]
"""Size in bytes, 1 if sent without pause, when sent and when received in ns of CLOCK_MONOTONIC."""


def results(messages: list[Message]) -> dict[str, float]:
    """µs on the way and messages a second, of each size."""
    found: dict[str, float] = {}
    for size in SIZES:
        calm, fast = (those_of(messages, size, is_fast) for is_fast in (0, 1))
        delays = [(received - sent) / 1000 for *_, sent, received in calm]
        found[f"latency of {name_of(size)}"] = statistics.median(delays)
        took = (fast[-1][3] - fast[0][3]) / 1e9
        found[f"throughput of {name_of(size)} messages"] = (len(fast) - 1) / took
    return found


def those_of(messages: list[Message], size: int, is_fast: int) -> list[Message]:
    """One part of the pattern. Dora may discard some on a loaded machine; not most."""
    found = [one for one in messages if one[:2] == (size, is_fast)]
    assert len(found) > COUNT / 2, f"{len(found)} of {COUNT} messages of {size} bytes"
    return found


def name_of(size: int) -> str:
    """A size in words."""
    for factor, unit in ((1_000_000, "MB"), (1000, "kB")):
        if size >= factor:
            return f"{round(size / factor)} {unit}"
    return f"{size} B"


def life(contestant: Contestant) -> dict[str, float]:
    """One run of the dataflow."""
    clear_stamps()
    contestant.start()
    (done,) = wait_stamps("messages", 1, 120)
    wait_gone([done.pid])
    contestant.stop()
    return results([tuple(one) for one in json.loads(RESULT.read_text())])


def measure(rounds: int) -> list[Figure]:
    """All sizes."""
    project = make_home()
    project.write("sender.py", SENDER)
    project.write("receiver.py", RECEIVER)
    with prepared(
        (Doractl, DoraUpOfUser, DoraRunOfUser), project.write("messages.yml", YAML)
    ) as contestants:
        lives = take_turns({one.name: partial(life, one) for one in contestants}, rounds)
    figures = []
    for what in sorted(lives["doractl"][0], key=lambda what: what.split()[0]):
        unit = "µs" if what.startswith("latency") else "1/s"
        values = {name: [one[what] for one in found] for name, found in lives.items()}
        figures.append(shown(Figure(what, unit, values, "1.00 ± 0.02")))
    return figures


if __name__ == "__main__":
    keep("messages", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 40)

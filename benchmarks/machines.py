"""Latency and throughput between two machines.  `python -m benchmarks.machines [N]`

Needs LAB=machines: the sender is on a, the receiver on b, and their CLOCK_MONOTONIC is the same.
Bare dora has a coordinator and a daemon on the address of a, a daemon on that of b, no password. It
runs as root, but may lock no more memory than the nodes of ours, which the lab's container cannot
give more: where 8 MiB do not suffice, both copy messages that else are in shared memory.
"""

import json
import shlex
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path

from benchmarks.rounds import OURS, Figure, keep, shown, take_turns
from tests.machines.direct import ADDRESSES
from tests.machines.wires import there
from tests.system.cells import Cell, Project, run, wait_for

HOME = Path("/srv/bench")
STAMPS = HOME / "stamps"
RESULT = STAMPS / "machines.json"
NAME = "across"
SECONDS = 120.0
"""For one run."""
BARE = "dora"
LINKS = ("link: direct", "link: ssh")
HEAD, MEMBER = "a", "b"
SENDER = """
import time
from dora import Node
import os, pyarrow
node = Node()
time.sleep(3)
def send(what, size, count, pause):
    buffers = [None, pyarrow.py_buffer(os.urandom(size))]
    data = pyarrow.Array.from_buffers(pyarrow.uint8(), size, buffers)
    due = time.monotonic()
    for number in range(count):
        node.send_output("data", data, {"what": what, "sent": time.monotonic_ns()})
        due += pause
        time.sleep(max(due - time.monotonic(), 0))
    time.sleep(1)
send("", 40_960, 100, 0.01)
send("41 kB", 40_960, 800, 0.01)
send("1 MB", 1_000_000, 240, 1 / 30)
send("fast", 40_960, 20_000, 0)
"""
RECEIVER = f"""
import json, os, time
from dora import Node
found = []
for event in Node():
    if event["type"] == "INPUT":
        about = event["metadata"]
        found.append((about["what"], about["sent"], time.monotonic_ns()))
with open("{RESULT}.new", "w") as file:
    json.dump(found, file)
os.rename("{RESULT}.new", "{RESULT}")
"""
YAML = f"""nodes:
  - id: sender
    path: sender.py
    outputs: [data]
    deploy: {{machine: {HEAD}, working_dir: {HOME}}}
  - id: receiver
    path: receiver.py
    inputs: {{data: {{source: sender/data, queue_size: 1000}}}}
    deploy: {{machine: {MEMBER}, working_dir: {HOME}}}
"""
SIZES = {"41 kB": 40_960, "1 MB": 1_000_000}
GOALS = {LINKS[0]: "1.00 × dora", LINKS[1]: "41 kB 2.2 ×, 1 MB 5.4 ×, 0.23 ×"}
"""For ssh what the trial has shown that came before all this."""
Message = tuple[str, int, int]
"""Which part of the pattern, when sent and when received in ns of CLOCK_MONOTONIC."""


def results(messages: list[Message]) -> dict[str, float]:
    """ms on the way, and MB a second."""
    found: dict[str, float] = {}
    for size in SIZES:
        delays = sorted((came - sent) / 1e6 for what, sent, came in messages if what == size)
        found[f"latency of {size}, median"] = statistics.median(delays)
        found[f"latency of {size}, 99 of 100"] = delays[len(delays) * 99 // 100]
    times = [came for what, _, came in messages if what == "fast"]
    megabytes = (len(times) - 1) * SIZES["41 kB"] / 1e6
    found["throughput of 41 kB messages"] = megabytes / ((times[-1] - times[0]) / 1e9)
    return found


def prepare() -> None:
    """The same files on both machines."""
    project = Project(HOME)
    STAMPS.mkdir()
    STAMPS.chmod(0o777)
    for name, text in (("sender.py", SENDER), ("receiver.py", RECEIVER), ("flow.yml", YAML)):
        project.write(name, text)
    there(MEMBER, "rm", "-rf", str(HOME))
    subprocess.run(["scp", "-q", "-r", "-p", str(HOME), f"root@{MEMBER}:{HOME}"], check=True)


def start_ours(link: str) -> None:
    """By doractl, with the settings beside the file."""
    more = f", link: direct, address: {ADDRESSES[MEMBER]}" if link == LINKS[0] else ""
    entry = f"{{host: {MEMBER}, writable: {STAMPS}{more}}}"
    Project(HOME, is_new=False).write("flow.systemd.yml", f"machines:\n  {MEMBER}: {entry}\n")
    words = ("--name", NAME, "--start-timeout=300s")
    run("doractl", "start", str(HOME / "flow.yml"), *words)


def stop_ours() -> None:
    """Also if it has ended by itself."""
    with suppress(AssertionError):
        run("doractl", "stop", NAME)
    Cell(NAME).end()


def start_bare() -> None:
    """As in dora's manual, but each process in a unit, which ends its children too."""
    coordinator = ("--interface", ADDRESSES[HEAD], "--port", "6013")
    where = ("--coordinator-addr", ADDRESSES[HEAD], "--coordinator-port", "6013")
    daemon = ("daemon", *where, "--zenoh-no-multicast", "--zenoh-listen")
    unit(HEAD, "coordinator", "coordinator", *coordinator)
    wait_for("the coordinator listens", lambda: "6013" in run("ss", "-Hltn").stdout)
    unit(HEAD, "daemon", *daemon, f"{ADDRESSES[HEAD]}:61001", "--machine-id", HEAD)
    unit(MEMBER, "daemon", *daemon, f"{ADDRESSES[MEMBER]}:61002", "--machine-id", MEMBER)
    start = ("dora", "start", str(HOME / "flow.yml"), "--detach", "--name", NAME, *where)
    wait_for("both daemons are there", lambda: len(daemons(where)) == len((HEAD, MEMBER)))
    run(*start)


def daemons(where: tuple[str, ...]) -> list[str]:
    """Those that the coordinator knows."""
    lines = run("dora", "cluster", "status", *where, check=False).stdout.splitlines()
    return [one for one in lines if one.startswith((f"{HEAD}-", f"{MEMBER}-"))]


def unit(machine: str, name: str, *words: str) -> None:
    """A dora process on a machine."""
    place = ("-p", f"WorkingDirectory={HOME}", "-E", "HOME=/root", "-E", "PATH=/opt/lab/bin:/bin")
    locked = ("-p", "LimitMEMLOCK=8M", "-p", "CapabilityBoundingSet=~CAP_IPC_LOCK CAP_SYS_RESOURCE")
    command = ("systemd-run", "-q", "--collect", f"--unit=bare-{name}", *place, *locked)
    done = there(machine, shlex.join((*command, "/opt/lab/bin/dora", *words)))
    assert done.returncode == 0, done.stderr


def stop_bare() -> None:
    """All processes on both machines."""
    for machine in (HEAD, MEMBER):
        there(machine, "systemctl", "stop", "bare-daemon", "bare-coordinator")


def has_result() -> bool:
    """Whether the receiver has ended."""
    return there(MEMBER, "test", "-e", str(RESULT)).returncode == 0


def life(start: Callable[[], None], stop: Callable[[], None]) -> dict[str, float]:
    """One run of the dataflow."""
    there(MEMBER, "rm", "-f", str(RESULT))
    try:
        start()
        wait_for("all is received", has_result, SECONDS)
        return results([tuple(one) for one in json.loads(there(MEMBER, "cat", str(RESULT)).stdout)])
    finally:
        stop()


def figures_of(lives: Mapping[str, list[dict[str, float]]]) -> Iterator[Figure]:
    """Each link beside bare dora."""
    for link in LINKS:
        for what in lives[BARE][0]:
            unit = "MB/s" if what.startswith("throughput") else "ms"
            pair = {OURS: lives[link], BARE: lives[BARE]}
            values = {name: [one[what] for one in found] for name, found in pair.items()}
            yield Figure(f"{what}, {link}", unit, values, GOALS[link])


def measure(rounds: int) -> list[Figure]:
    """All in turns."""
    prepare()
    contestants: dict[str, Callable[[], dict[str, float]]] = {
        one: partial(life, partial(start_ours, one), stop_ours) for one in LINKS
    }
    contestants[BARE] = partial(life, start_bare, stop_bare)
    return [shown(one) for one in figures_of(take_turns(contestants, rounds))]


if __name__ == "__main__":
    keep("machines", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 5)

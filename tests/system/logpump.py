"""Nodes that print numbered lines, read by LogPipes into the journal; run as a program.

usage: logpump.py [--nodes N] [--lines N] [--width BYTES] [--quiet N] [--socket PATH]

Prints one line of JSON: the dataflow's uuid, lines per second, CPU seconds and peak memory in KiB
of the reading side. A quiet node's lines hold the time at which they were printed, in µs.
"""

import argparse
import asyncio
import json
import resource
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

from dora_systemd.adapters.journal.note import JOURNAL_SOCKET
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.lost_entries import LossWatch

FLOOD = """
import sys
text = " " + "x" * ({width} - 9)
for first in range(0, {lines}, 1000):
    numbers = range(first, min(first + 1000, {lines}))
    sys.stdout.write("".join("%08d%s\\n" % (number, text) for number in numbers))
"""
QUIET = """
import time
for number in range({lines}):
    print("%08d %d" % (number, time.time_ns() // 1000), flush=True)
    time.sleep(0.01)
"""
LAUNCH = 'exec >"$0" 2>"$1"; exec "$2" -c "$3"'


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--nodes", type=int, default=1)
    parser.add_argument("--lines", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=80)
    parser.add_argument("--quiet", type=int, default=0, help="lines of one quiet node")
    parser.add_argument("--socket", default=JOURNAL_SOCKET)
    return parser.parse_args()


def launch(paths: CellPaths, node: str, code: str) -> "subprocess.Popen[bytes]":
    pipes = [str(paths.node_stdout(node)), str(paths.node_stderr(node))]
    return subprocess.Popen(["sh", "-c", LAUNCH, *pipes, sys.executable, code])


def watch_losses(journal: JournalSocket, pipes: LogPipes) -> LossWatch:
    def report(count: int) -> None:
        pipes.write_event("lines-lost", count=count, reason="rate limit of journald")

    return LossWatch(
        lambda: journal.sent, JournalReader().count_own, report, lambda: time.time_ns() // 1000
    )


async def pump(options: argparse.Namespace, paths: CellPaths) -> dict[str, object]:
    identity = Origin("pump", str(uuid.uuid4()))
    journal = JournalSocket(options.socket)
    pipes = LogPipes(asyncio.get_running_loop(), journal, identity)
    codes = {f"n{i}": FLOOD.format(**vars(options)) for i in range(options.nodes)}
    if options.quiet:
        codes["quiet"] = QUIET.format(lines=options.quiet)
    for node in codes:
        pipes.make(node, paths)
    nodes = {node: launch(paths, node, code) for node, code in codes.items()}
    start, cpu = time.monotonic(), time.process_time()
    pipes.set_run(str(uuid.uuid4()))
    for node, process in nodes.items():
        pipes.open(node)
        pipes.set_pid(node, process.pid)
    watch = watch_losses(journal, pipes)
    while any(process.poll() is None for process in nodes.values()):
        await asyncio.sleep(0.01)
    pipes.settle(120)
    await watch.finish()
    for node, process in nodes.items():
        pipes.drain(node)
        pipes.write_event("node-exited", node, exit=f"exit code {process.returncode}")
    pipes.write_event("dataflow-finished")
    pipes.close(120)
    seconds = time.monotonic() - start
    return {
        "uuid": identity.uuid,
        "lines_per_second": round(options.lines * options.nodes / seconds),
        "cpu_seconds": round(time.process_time() - cpu, 2),
        "peak_kib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }


def main() -> None:
    options = parse()
    with tempfile.TemporaryDirectory() as directory:
        paths = CellPaths(Path(directory))
        paths.io.mkdir()
        print(json.dumps(asyncio.run(pump(options, paths))), flush=True)


if __name__ == "__main__":
    main()

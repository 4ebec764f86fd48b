"""Requests at a steady rate, and what the gateway uses meanwhile.

By hand, in the lab, with the gateway up: python -m tests.system.gatewayload 60
"""

import http.client
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.lab.pace import bound, pace
from tests.system.gateways import Front

RATE = 100
"""Requests in a second, of an idle machine."""

_CLIENTS = 8


class Use(NamedTuple):
    """What a process holds. memory: bytes that are its own."""

    memory: int
    descriptors: int
    threads: int


class Load(NamedTuple):
    """What came of it: answers by path and status, and the longest time one took, in seconds."""

    answers: Counter[str]
    longest: float
    seconds: float


def read_use(pid: int) -> Use:
    """What the process `pid` holds now."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    count = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return Use(int(status["RssAnon"].split()[0]) * 1024, count, int(status["Threads"]))


def ask_steadily(port: int, paths: tuple[str, ...], seconds: float) -> Load:
    """RATE requests a second, on the clock, whether answers are slow or not.

    On a slow machine fewer: what is asked beyond what it can do says nothing about the gateway.
    """
    rate = RATE / pace()
    answers: Counter[str] = Counter()
    longest = 0.0
    begin = time.monotonic()
    with ThreadPoolExecutor(_CLIENTS) as clients:
        count = int(seconds * rate)
        tasks = [(begin + n / rate, paths[n % len(paths)]) for n in range(count)]
        for path, status, took in clients.map(lambda one: _ask(port, *one), tasks):
            answers[f"{path} {status}"] += 1
            longest = max(longest, took)
    return Load(answers, longest, time.monotonic() - begin)


HALF_OPEN = """
import socket, sys, time
held = []
for _ in range(int(sys.argv[2])):
    held.append(socket.create_connection(("127.0.0.1", int(sys.argv[1])), 5))
    try:
        held[-1].send(b"GET / HTTP/1.1\\r\\n")
    except OSError:
        pass
print("held", flush=True)
time.sleep(float(sys.argv[3]))
"""


@contextmanager
def half_open(port: int, user: str, count: int, seconds: float) -> Iterator[None]:
    """A user who begins so many requests at once and ends none of them."""
    script = ["python3", "-c", HALF_OPEN, str(port), str(count), str(seconds)]
    command = ["runuser", "-u", user, "--", *script]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        assert child.stdout.readline() == "held\n"
        try:
            yield
        finally:
            child.kill()


def _ask(port: int, at: float, path: str) -> tuple[str, int, float]:
    time.sleep(max(0.0, at - time.monotonic()))
    start = time.monotonic()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=bound(30))
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        response.read()
        return path, response.status, time.monotonic() - start
    finally:
        connection.close()


if __name__ == "__main__":
    front = Front()
    known = tuple(sys.argv[2:]) or ("/health", "/nothing")
    ask_steadily(front.port, known, 3)
    before, pid = read_use(front.pid), front.pid
    print(before)
    for _ in range(6):
        load = ask_steadily(front.port, known, float(sys.argv[1]) / 6)
        print(load, read_use(pid), front.pid == pid)

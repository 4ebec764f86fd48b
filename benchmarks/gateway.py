"""The gateway beside up to 200 dataflows: a scrape of /metrics, and a page that is open.

`python -m benchmarks.gateway [N]`
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from websockets.sync.client import ClientConnection, connect

from benchmarks.cost import cpu_seconds
from benchmarks.crowd import COUNTS, crowd
from benchmarks.flows import make_home
from benchmarks.rounds import OURS, Figure, Measure, alternate, keep, shown
from benchmarks.startup import timed
from tests.system.cells import run
from tests.system.gateways import Front

LOOKS = 5
"""Snapshots of one round: one each two to ten seconds."""


@contextmanager
def front() -> Iterator[Front]:
    """The system's gateway, and nothing of it afterwards."""
    one = Front()
    one.up()
    try:
        yield one
    finally:
        one.end()


def scrape_figure(gateway: Front, count: int, rounds: int) -> Figure:
    """All that Prometheus gets, beside all that systemd tells of the same units."""
    everything = ("systemctl", "--no-pager", "show", "dora-*.service")
    measures: dict[str, Measure] = {
        OURS: partial(timed, partial(scrape, gateway)),
        "systemctl show": partial(timed, partial(run, *everything)),
    }
    for warm_up in measures.values():
        warm_up()
    goal = "200: ≤ 300 ms"
    return alternate(f"scrape of /metrics with {count}", "ms", measures, rounds, goal=goal)


def scrape(gateway: Front) -> None:
    """One answer, whole."""
    reply = gateway.get("/metrics")
    assert reply.status == 200, reply.body


def look_figure(gateway: Front, count: int, rounds: int) -> Figure:
    """The gateway's own processor time while one page shows all of them."""
    values = {OURS: [look_percent(gateway) for _ in range(rounds)]}
    return shown(Figure(f"CPU of an open page with {count}", "%", values, "200: ≤ 2 %"))


def look_percent(gateway: Front) -> float:
    """Percent of a processor, from one snapshot to the last of LOOKS."""
    with connect(f"ws://127.0.0.1:{gateway.port}/api/live", max_size=None) as page:
        wait_snapshot(page)
        before, begun = cpu_seconds(gateway.pid), time.monotonic()
        for _ in range(LOOKS):
            wait_snapshot(page)
        return 100 * (cpu_seconds(gateway.pid) - before) / (time.monotonic() - begun)


def wait_snapshot(page: ClientConnection) -> None:
    """The next snapshot of all dataflows."""
    while json.loads(page.recv(30))["type"] != "snapshot":
        pass


def measure(rounds: int, counts: tuple[int, ...] = COUNTS) -> list[Figure]:
    """Both at each number."""
    scrapes, looks = [], []
    with crowd(make_home()) as everyone, front() as gateway:
        for count in counts:
            everyone.grow_ours(count)
            scrapes.append(scrape_figure(gateway, count, rounds))
            looks.append(look_figure(gateway, count, max(rounds // 2, 1)))
    return [*scrapes, *looks]


if __name__ == "__main__":
    keep("gateway", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 10)

"""A file is saved, until what runs from it is ready again.  `python -m benchmarks.reload [N]`"""

import json
import os
import sys
import time
from functools import partial
from pathlib import Path

from benchmarks.contestants import NAME, Contestant, Doractl, Pm2, prepared
from benchmarks.flows import HOME, STAMPS, clear_stamps, make_home, wait_stamps, write_flow
from benchmarks.rounds import Figure, alternate, keep
from tests.system.cells import run

COUNT = 2
PAUSE_SECONDS = 1.0
"""Between two saves, so that each is one of its own."""


class HotReload(Doractl):
    """Ours, with its hot reload: of the two nodes only the one whose file it is starts again."""

    restarted = 1

    def start(self) -> None:
        settings = ("--writable", str(STAMPS), "--hot-reload")
        run("doractl", "start", str(self.flow), "--name", NAME, *settings)


class Watch(Pm2):
    """pm2 and its watch option: `dora run` starts again. A stop would end the watch for ever."""

    name = "pm2, watch"
    restarted = COUNT

    def prepare(self) -> None:
        app = {
            **{"name": NAME, "script": "/opt/lab/bin/dora", "args": f"run {self.flow}"},
            **{"interpreter": "none", "cwd": str(HOME), "watch": [str(HOME / "sink.py")]},
        }
        apps = HOME / "apps.json"
        apps.write_text(json.dumps({"apps": [app]}))

    def start(self) -> None:
        self.control("start", str(HOME / "apps.json"))

    def stop(self) -> None:
        self.control("delete", NAME)


def begin(contestant: Contestant) -> None:
    """Have it run, and watch."""
    clear_stamps()
    contestant.start()
    wait_stamps("input", COUNT - 1)


def save_ms(contestant: HotReload | Watch, own: list[float]) -> float:
    """One save. own: gets what the new node itself needed for its start."""
    begin(contestant)
    time.sleep(PAUSE_SECONDS)
    clear_stamps()
    path = HOME / "sink.py"
    begun = time.monotonic()
    path.write_text(path.read_text() + "\n")
    fresh = wait_stamps("ready", contestant.restarted)
    last = max(fresh, key=lambda stamp: stamp.at)
    own.append((last.at - born_at(last.pid)) * 1000)
    contestant.stop()
    return (last.at - begun) * 1000


def born_at(pid: int) -> float:
    """When a process was forked, in seconds of CLOCK_MONOTONIC, to 10 ms: proc_pid_stat(5)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(fields[19]) / os.sysconf("SC_CLK_TCK")


def measure(rounds: int) -> list[Figure]:
    """From the save to the node that is ready."""
    flow = write_flow(make_home(), COUNT)
    with prepared((HotReload, Watch), flow) as contestants:
        own: dict[str, list[float]] = {one.name: [] for one in contestants}
        measures = {
            one.name: partial(save_ms, one, own[one.name])
            for one in contestants
            if isinstance(one, HotReload | Watch)
        }
        figure = alternate("save until ready", "ms", measures, rounds)
        added = {
            name: [whole - start for whole, start in zip(found, own[name], strict=True)]
            for name, found in figure.values.items()
        }
        return [figure, Figure("of that, not the node's own start", "ms", added, "≤ 250 ms")]


if __name__ == "__main__":
    keep("reload", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)

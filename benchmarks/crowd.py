"""Many programs at once, with each of those who can list them.

Ours are whole dataflows. For the others it is easier: a dataflow or a program that only sleeps.
"""

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from benchmarks.contestants import (
    CIRCUS_WATCHER,
    SUPERVISED,
    Circus,
    Contestant,
    DoraUp,
    Pm2,
    Supervisord,
)
from benchmarks.flows import HOME, STAMP
from tests.system.cells import Cell, Project, run

LIGHT = f"""{STAMP}
node = Node()
if os.access("{HOME}/stamps", os.W_OK):
    stamp("ready")
for event in node:
    pass
"""
LIGHT_YAML = "nodes: [{id: light, path: light.py, inputs: {tick: dora/timer/secs/10}}]"
SLEEP_YAML = "nodes: [{id: asleep, path: /usr/bin/sleep, args: infinity}]"
SLEEP = "/usr/bin/sleep infinity"
COUNTS = (1, 10, 50, 200)
"""How many of them are measured."""
AT_ONCE = 3
DORA_AT_MOST = 50
"""Beside 200 of ours `dora start` gives up: the one daemon of all reads all processes, too."""


def light_flow(project: Project) -> Path:
    """One node that has nothing to do."""
    project.write("light.py", LIGHT)
    return project.write("light.yml", LIGHT_YAML)


class Crowd:
    """Ours and the rivals', with the same number of programs each."""

    def __init__(self, project: Project) -> None:
        self.flow = light_flow(project)
        self.asleep = project.write("asleep.yml", SLEEP_YAML)
        self.cells: list[Cell] = []
        self.dora = DoraUp(self.flow)
        self.dora.prepare()
        self.supervised: list[Contestant] = []
        self.has_dora = True

    def grow(self, count: int) -> None:
        """Have `count` of each."""
        self._forget()
        fresh = self.grow_ours(count)
        self.has_dora = count <= DORA_AT_MOST
        for cell in fresh if self.has_dora else []:
            self.dora.dora("start", str(self.asleep), "--name", cell.name, "--detach")
        self._supervise([cell.name for cell in self.cells])

    def grow_ours(self, count: int) -> list[Cell]:
        """Have `count` of ours; those that were started for it."""
        fresh = [Cell(f"crowd-{number}") for number in range(len(self.cells), count)]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(lambda cell: cell.start(self.flow), fresh))
        self.cells += fresh
        return fresh

    @property
    def rivals(self) -> list[Contestant]:
        """All but ours that have as many."""
        return [*([self.dora] if self.has_dora else []), *self.supervised]

    def _supervise(self, names: list[str]) -> None:
        supervisord, circus, pm2 = Supervisord(self.flow), Circus(self.flow), Pm2(self.flow)
        programs = (SUPERVISED.format(name=name, command=SLEEP) for name in names)
        supervisord.begin("".join(programs).replace("autostart=false", "autostart=true"))
        watchers = (CIRCUS_WATCHER.format(name=name, command=SLEEP) for name in names)
        circus.begin("".join(watchers).replace("autostart = False", "autostart = True"))
        app = {"script": "/usr/bin/sleep", "args": "infinity", "interpreter": "none"}
        apps = HOME / "apps.json"
        apps.write_text(json.dumps({"apps": [{"name": name, **app} for name in names]}))
        pm2.control("start", str(apps))
        self.supervised = [supervisord, circus, pm2]

    def _forget(self) -> None:
        for one in self.supervised:
            one.close()
        self.supervised = []

    def close(self) -> None:
        """Nothing is left."""
        self._forget()
        self.dora.close()
        units = [cell.unit for cell in self.cells]
        if units:
            run("systemctl", "stop", *units)


@contextmanager
def crowd(project: Project) -> Iterator[Crowd]:
    """An empty crowd, and nothing of it afterwards."""
    one = Crowd(project)
    try:
        yield one
    finally:
        one.close()

"""All that stops a dataflow, and whether its recorder has saved everything then."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dora_systemd.decisions.views.dataflows import format_table
from tests.system import recorders
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.gateways import Front
from tests.system.releases import ETC, Releases

REBOOT = "reboot"
SECONDS = int(os.environ.get("SAVE_SECONDS", "0"))
"""What the recorder needs to complete its file; 0 for twice the grace duration."""
HEADER = ("KIND", "COUNT", "LOST", "OVERTAKEN")


@dataclass
class Table:
    """What has been seen. stops: of all kinds. episodes: how many the recorder has saved.

    counts, lost: by kind. overtaken: those of which dora dropped the last message of a source, see
    recorders.is_overtaken(). version: of the project.
    """

    stops: int = 0
    episodes: int = 0
    version: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    overtaken: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        columns = (self.counts, self.lost, self.overtaken)
        rows = [[kind, *(str(one.get(kind, 0)) for one in columns)] for kind in self.counts]
        return format_table(HEADER, [*rows, ["all", *(str(sum(one.values())) for one in columns)]])


class Story:
    """A dataflow with a recorder, which runs between two stops."""

    def __init__(self, cell: Cell, project: Project, table: Table) -> None:
        self.cell, self.project, self.table = cell, project, table
        self.releases = Releases(cell)
        self.front = Front()
        self.flow = project.root / "flow.yml"

    def begin(self) -> None:
        """Write the dataflow, and start it."""
        recorders.flow(self.project, seconds=SECONDS)
        settings = self.project.root / "flow.systemd.yml"
        # Its failure ends the dataflow.
        settings.write_text(settings.read_text() + "  camera: {essential: yes}\n")
        self.start()

    def start(self) -> None:
        """Start it after a stop."""
        if self.is_deployed:
            self.cell.systemctl("start")
        else:
            self.cell.start(self.flow)
        self.wait_records()

    @property
    def is_deployed(self) -> bool:
        """Whether a release runs."""
        return (ETC / self.cell.unit).exists()

    def wait_records(self) -> None:
        """Return when the run after the last stop records."""
        runs = self.table.stops + 1
        wait_for("it records", lambda: recorders.records(self.cell) >= runs, 120)

    def stop(self, kind: str) -> str:
        """Stop it once, and start it again unless that has done so; what is wrong, or ""."""
        KINDS[kind](self)
        return self.judge(kind)

    def judge(self, kind: str) -> str:
        """Look at what the recorder has saved, and let the dataflow record again."""
        self.table.stops += 1
        wrong = self._wrong(kind)
        counts, lost = self.table.counts, self.table.lost
        counts[kind] = counts.get(kind, 0) + 1
        lost[kind] = lost.get(kind, 0) + bool(wrong)
        if self.cell.is_gone:
            self.start()
        self.wait_records()
        return wrong

    def _wrong(self, kind: str) -> str:
        if recorders.parts(self.project):
            for one in recorders.parts(self.project):
                one.unlink()
            return "the recorder was killed"
        episodes = recorders.episodes(self.project)
        new, self.table.episodes = len(episodes) - self.table.episodes, len(episodes)
        if new != 1:
            return f"{new} new episodes"
        sources = [] if kind in _SOURCES_RUN_ON else ["arm"] if kind == "failure" else _SOURCES
        for node in sources:
            sent = recorders.ends(self.cell, node)[-1][1]
            if episodes[-1][node] == sent:
                continue
            if not recorders.is_overtaken(episodes[-1], node, sent):
                return f"{node} sent {sent}, and {episodes[-1][node]} were saved"
            self.table.overtaken[kind] = self.table.overtaken.get(kind, 0) + 1
        return ""

    def end(self) -> None:
        """Leave nothing of it."""
        self.releases.end()
        self.front.end()


_SOURCES = ["camera", "arm"]
_SOURCES_RUN_ON = ("node restart", "reload of a node")


def _doractl(*words: str) -> Callable[[Story], None]:
    def act(story: Story) -> None:
        story.cell.doractl(*words, story.cell.name)

    return act


def _systemctl(verb: str) -> Callable[[Story], None]:
    def act(story: Story) -> None:
        story.cell.systemctl(verb)

    return act


def _reload(story: Story) -> None:
    """A key of the dataflow itself: dora reads it at the start only."""
    story.table.version += 1
    text = f"{recorders.FLOW}health_check_interval: {60 + story.table.version}.0\n"
    story.project.write("flow.yml", text)
    story.cell.doractl("reload", story.cell.name)


def _reload_node(story: Story) -> None:
    story.table.version += 1
    story.project.write("recorder.py", f"{recorders.RECORDER}# {story.table.version}\n")
    story.cell.doractl("reload", story.cell.name)


def _restart_node(story: Story) -> None:
    story.cell.doractl("node", "restart", story.cell.name, "recorder")
    saved, before = recorders.saved(story.project), story.table.episodes
    wait_for("it has saved", lambda: len(list(saved.glob("*.json"))) > before, 60 + SECONDS)


def _deploy(story: Story) -> None:
    story.table.version += 1
    story.project.write("version", str(story.table.version))
    story.releases.deploy(story.flow, "--soak", "0s")


def _stop_and_deploy(story: Story) -> None:
    """A deploy refuses to replace what `doractl start` has started."""
    story.cell.doractl("stop", story.cell.name)
    _deploy(story)


def _rollback(story: Story) -> None:
    story.cell.doractl("rollback", story.cell.name)


def _destroy(story: Story) -> None:
    story.cell.doractl("destroy")
    story.releases.end()


def _dora_stop(story: Story) -> None:
    story.front.up()
    coordinator = {"ADDR": "127.0.0.1", "PORT": str(story.front.port)}
    variables = {f"DORA_COORDINATOR_{key}": value for key, value in coordinator.items()}
    run("dora", "stop", story.cell.name, env={**os.environ, **variables})
    story.front.end()


def _fail(story: Story) -> None:
    (pid,) = [one.pid for node, one in story.cell.status.nodes.items() if node == "camera"]
    run("kill", "-KILL", str(pid))
    wait_for("it ends", lambda: story.cell.is_gone, 60 + SECONDS)


KINDS: Mapping[str, Callable[[Story], None]] = {
    "doractl stop": _doractl("stop"),
    "doractl restart": _doractl("restart"),
    "reload": _reload,
    "failure": _fail,
    "systemctl stop": _systemctl("stop"),
    "systemctl restart": _systemctl("restart"),
    "reload of a node": _reload_node,
    "node restart": _restart_node,
    "dora stop": _dora_stop,
    "stop before a deploy": _stop_and_deploy,
    "deploy": _deploy,
    "rollback": _rollback,
    "destroy": _destroy,
}
"""By name; in this order each finds what it needs."""


def read_table(path: Path) -> Table | None:
    """The table that was written before a reboot."""
    return Table(**json.loads(path.read_text())) if path.exists() else None


def next_kinds(table: Table, count: int) -> Sequence[str]:
    """The kinds of the next stops."""
    names, begun = list(KINDS), table.stops - table.counts.get(REBOOT, 0)
    return [names[number % len(names)] for number in range(begun, begun + count)]

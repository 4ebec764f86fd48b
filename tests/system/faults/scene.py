"""The dataflow under load that a fault is applied to, and what can be seen of it from outside."""

import json
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.lab.pace import bound
from tests.system.cells import Cell, Project, journalctl, run, wait_for

ROLES = ("source", "doubler", "sink")
FLOW = """
nodes:
  - id: source
    path: node.py
    args: source
    inputs: {{tick: dora/timer/millis/{tick}}}
    outputs: [number]{more}
  - id: doubler
    path: node.py
    args: doubler
    inputs: {{number: {{source: source/number, queue_size: 1000}}}}
    outputs: [number]{more}
  - id: sink
    path: node.py
    args: sink
    inputs: {{number: {{source: doubler/number, queue_size: 1000}}}}{more}
"""
IS_VM = os.environ.get("LAB") == "vm"
"""A kernel in user mode: programs start about four times slower."""


@dataclass(frozen=True)
class State:
    """What a fault may change."""

    restarts: int
    node_restarts: dict[str, int]
    pids: dict[int, str]
    counts: dict[str, int]


@dataclass
class Scene:
    """A cell with three nodes that print numbered lines and note how many.

    before: the state when the fault is applied. mounts: what is to be unmounted at the end.
    """

    cell: Cell
    project: Project
    before: State = field(init=False)
    mounts: list[Path] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.notes.mkdir(parents=True, exist_ok=True)
        self.notes.chmod(0o777)

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        if self.mounts:
            self.cell.end()
        self.unmount()

    def mount(self, place: Path, size: str) -> None:
        """Put a small file system of its own at `place`."""
        run("mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", str(place))
        self.mounts.append(place)

    def unmount(self) -> None:
        """Take away all of these."""
        while self.mounts:
            run("umount", "--lazy", str(self.mounts.pop()))

    @property
    def notes(self) -> Path:
        """Where nodes note what they printed, and find orders."""
        return self.project.root.parent / "notes"

    @property
    def mark(self) -> str:
        """What the environment of every process of the cell has, wherever it has got to."""
        return f"NOTES={self.notes}"

    def start(self, flags: tuple[str, ...], answers: float) -> None:
        """Start the dataflow, and return when all nodes are under load. answers: see Fault."""
        shutil.copy(Path(__file__).with_name("node.py"), self.project.root)
        # A node that only gets no processor answers as late as everything else is there.
        health = f"\n    health_check_timeout: {bound(answers):.1f}" if answers else ""
        text = FLOW.format(tick=200 if IS_VM else 10, more=health)
        flow = self.project.write("dataflow.yml", text)
        self.cell.start(flow, "--env", self.mark, "--writable", str(self.notes), *flags)
        wait_for("load", lambda: min(self.counts().get(role, 0) for role in ROLES) > 20, 120)
        self.before = self.state()

    def order(self, role: str, what: str) -> None:
        """Have a node do something; return when it has begun."""
        order = self.notes / f"order.{role}.{what}"
        draft = self.notes / "draft"
        draft.touch()
        draft.chmod(0o666)
        draft.rename(order)  # whole when the node sees it: it looks at any moment
        wait_for("it obeys", lambda: not order.exists())

    def lives(self, role: str) -> dict[str, int]:
        """How many lines each life of a node has noted, oldest first."""
        found = sorted(self.notes.glob(f"{role}.*"))
        return {path.name: int(path.read_text() or 0) for path in found}

    def counts(self) -> dict[str, int]:
        """How many lines the last life of each node has noted."""
        every = {role: list(self.lives(role).values()) for role in ROLES}
        return {role: counts[-1] for role, counts in every.items() if counts}

    def state(self) -> State:
        """What there is now."""
        nodes = self.cell.status.nodes
        return State(
            int(self.cell.show("NRestarts")),
            {role: nodes[role].restarts for role in ROLES},
            self.cell.all_pids(),
            {life: count for role in ROLES for life, count in self.lives(role).items()},
        )

    def listed(self) -> dict[str, Any]:
        """What `doractl list` says."""
        done = self.cell.doractl("list", self.cell.name, "-o", "json", check=False)
        row: dict[str, Any] = json.loads(done.stdout)
        return row

    def processes(self) -> dict[int, str]:
        """The group of every process that comes from this dataflow."""
        found = {}
        for directory in Path("/proc").glob("[0-9]*"):
            try:
                if self.mark.encode() in (directory / "environ").read_bytes().split(b"\0"):
                    found[int(directory.name)] = (directory / "cgroup").read_text().strip()[3:]
            except OSError:
                pass
        return {pid: group for pid, group in found.items() if pid != os.getpid()}

    def printed(self) -> dict[str, list[int]]:
        """The numbers that the journal has of each life, in its order."""
        found: dict[str, list[int]] = {}
        where = (f"_SYSTEMD_UNIT={self.cell.unit}", "DORA_STREAM=stdout")
        for line in journalctl("-o", "cat", *where).splitlines():
            life, _, number = line.partition(" ")
            if life.partition(".")[0] in ROLES and number.isdecimal():
                found.setdefault(life, []).append(int(number))
        return found

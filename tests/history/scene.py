"""Where a history happens: two projects, the shell that carries out steps, and what is left."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from tests.history import member
from tests.history.steps import CELLS
from tests.system.cells import run
from tests.system.gateways import Front

PREAMBLE = Path(__file__).with_name("preamble.sh")
NODE = Path(__file__).parents[1] / "system/faults/node.py"
FLOW = """
nodes:
  - id: source
    path: node.py
    args: source
    inputs: {tick: dora/timer/millis/50}
    outputs: [number]
    restart_policy: on-failure
    max_restarts: 0
  - id: sink
    path: node.py
    args: sink
    inputs: {number: {source: source/number, queue_size: 1000}}
    restart_policy: on-failure
    max_restarts: 0
"""
DEVICES = Path("/run/history-devices")
"""What stands for a device of each dataflow, which its sink needs; not one on another machine."""
PLACES = ("/run/dora-systemd", "/run/systemd", "/etc/systemd/system", "/run/dora-gateway")
IGNORED = (
    *("/run/systemd/journal", "/run/systemd/sessions", "/run/systemd/users"),
    # systemd 257 never deletes these of any unit, whoever made it.
    "/run/systemd/units/log-extra-fields:",
)


class Scene:
    """The directory of a whole history, with a project for each dataflow."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.front = Front()
        DEVICES.mkdir(exist_ok=True)
        for name in CELLS:
            self._make_project(root / name)
        root.chmod(0o755)
        member.bring(root)

    def _make_project(self, place: Path) -> None:
        for part in ("project", "notes"):
            (place / part).mkdir(parents=True)
        (place / "notes").chmod(0o777)
        shutil.copy(NODE, place / "project/node.py")
        (place / "project/dataflow.yml").write_text(FLOW + member.placement(place.name))
        device = DEVICES / place.name
        settings = f"nodes: {{sink: {{needs: {device}}}}}\n"
        if member.is_spread(place.name):
            settings = member.settings(place / "notes")
        (place / "project/dataflow.systemd.yml").write_text(settings)
        device.touch()

    def notes(self, cell: str) -> Path:
        """Where the nodes of a dataflow note how many lines they have printed."""
        return self.root / cell / "notes"

    def begin(self, shell: str, cell: str = CELLS[0]) -> subprocess.Popen[str]:
        """Begin to carry out lines of shell."""
        text = f". {PREAMBLE}\nof {cell}\n{shell}\n"
        return subprocess.Popen(
            ["bash", "-c", text],
            env={**os.environ, "WORK": str(self.root)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )

    def printed(self) -> dict[tuple[str, str], int]:
        """By dataflow and life of a node, how many lines it noted."""
        return {
            (cell, name): int(text or 0)
            for cell in CELLS
            for name, text in self._texts(cell).items()
            if not name.startswith("order.")
        }

    def _texts(self, cell: str) -> dict[str, str]:
        place = self.notes(cell)
        here = {note.name: note.read_text() for note in place.iterdir()}
        return here | member.read_notes(place, cell)


def ask(*words: str) -> Any:
    """The objects of `doractl ... -o json`, None if it prints none."""
    done = run("doractl", *words, "-o", "json", check=False)
    try:
        return json.loads(done.stdout)
    except ValueError:
        return None


def inventory() -> set[str]:
    """Everything of ours that a machine can have: files, units, groups."""
    listed = run("systemctl", "list-units", "--all", "--plain", "--no-legend", "dora*").stdout
    # The fields are unit, LoadState and ActiveState, see systemctl(1).
    rows = [line.split() for line in listed.splitlines()]
    units = {f"unit {row[0]}" for row in rows}
    units |= {f"failed unit {row[0]}" for row in rows if row[2] == "failed"}
    groups = Path("/sys/fs/cgroup").rglob("*history-*")
    return units | {f"group {path}" for path in groups} | {f"file {one}" for one in _files()}


def _files() -> list[str]:
    found = [path for place in PLACES for path in Path(place).rglob("*")]
    ours = (str(path) for path in found if "dora" in str(path))
    return [path for path in ours if not path.startswith(IGNORED)]

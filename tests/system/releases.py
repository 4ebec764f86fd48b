"""Releases in the system tests: a small project, and what must hold of the store."""

import hashlib
import json
import shutil
from pathlib import Path

from tests.system.cells import Cell, Project, run

STORE = Path("/var/lib/dora-systemd/releases")
CONTROL = Path("/run/systemd/system.control")
NODE = """
from dora import Node
print("version {version}", flush=True)
for event in Node():
    pass
"""
FLOW = "nodes: [{id: a, path: a.py, inputs: {t: dora/timer/millis/50}}]\n"


def write_version(project: Project, version: str, before: str = "") -> Path:
    """Write a version of the project, whose node runs `before` first; its dataflow file."""
    project.write("a.py", before + NODE.format(version=version))
    return project.write("dataflow.yml", FLOW)


class Releases:
    """The releases of the dataflow of a cell."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.path = STORE / cell.name
        self.trial = CONTROL / cell.unit

    def deploy(self, place: Path, *more: str, status: int = 0) -> str:
        """`doractl deploy`, and what it prints."""
        arguments = ("deploy", str(place), "--name", self.cell.name, *more)
        done = self.cell.doractl(*arguments, check=False)
        assert done.returncode == status, f"{done.returncode}: {done.stdout}{done.stderr}"
        return done.stdout + done.stderr

    def states(self) -> dict[str, str]:
        """The state of each release, newest first."""
        rows = json.loads(self.cell.doractl("releases", self.cell.name, "-o", "json").stdout)
        return {row["release"]: row["state"] for row in rows}

    def current(self) -> str:
        """The release that every start runs."""
        (found,) = [one for one, state in self.states().items() if state == "current"]
        return found

    def running(self) -> str:
        """The release that runs now, "" for none."""
        if self.cell.is_gone:
            return ""
        _, _, path = self.cell.show("ExecStart").partition(f"{self.path}/")
        return path.partition("/")[0]

    def check_whole(self) -> None:
        """Each tree is byte for byte what its manifest says, and nobody but root can change it."""
        for release in self.states():
            directory = self.path / release
            files = json.loads((directory / "release.json").read_text())["files"]
            tree = directory / "tree"
            there = {
                str(p.relative_to(tree))
                for p in tree.rglob("*")
                if p.is_symlink() or not p.is_dir()
            }
            assert there == files.keys()
            for path, facts in files.items():
                if "link" in facts:
                    assert str((tree / path).readlink()) == facts["link"]
                    continue
                data = (tree / path).read_bytes()
                assert hashlib.sha256(data).hexdigest() == facts["sha256"], path
                assert (tree / path).stat().st_mode & 0o222 == 0
                assert (tree / path).stat().st_uid == 0

    def end(self) -> None:
        """Leave nothing of all this."""
        self.cell.doractl("disable", self.cell.name, check=False)
        self.cell.end()
        for path in (self.trial, Path("/etc/systemd/system") / self.cell.unit):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.path, ignore_errors=True)
        (STORE / f".{self.cell.name}.lock").unlink(missing_ok=True)
        run("systemctl", "daemon-reload")

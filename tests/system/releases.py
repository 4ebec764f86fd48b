"""Releases in the system tests: a small project, and what must hold of the store."""

import hashlib
import json
import shutil
from pathlib import Path

from tests.system.cells import Cell, Project, run

STORE = Path("/var/lib/dora-systemd/releases")
ETC = Path("/etc/systemd/system")
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


def differences(release: Path) -> list[str]:
    """What is not as the manifest of the release in that directory says, or can be changed."""
    said = json.loads((release / "release.json").read_text())["files"]
    for facts in said.values():
        facts.pop("built", None)
    tree = release / "tree"
    places = [place for place in tree.rglob("*") if place.is_symlink() or not place.is_dir()]
    there = {str(place.relative_to(tree)): _facts(place) for place in places}
    wrong = [path for path in said.keys() | there.keys() if said.get(path) != there.get(path)]
    inside = [place.lstat() for place in (tree, *tree.rglob("*")) if not place.is_symlink()]
    wrong += ["can be changed"] if any(one.st_mode & 0o222 or one.st_uid for one in inside) else []
    return sorted(wrong)


def _facts(place: Path) -> dict[str, object]:
    """A file as a manifest describes it."""
    if place.is_symlink():
        return {"link": str(place.readlink())}
    data = place.read_bytes()
    is_executable = bool(place.stat().st_mode & 0o111)
    digest = hashlib.sha256(data).hexdigest()
    return {"size": len(data), "executable": is_executable, "sha256": digest}


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
            assert differences(self.path / release) == [], release

    def check_only(self, release: str) -> None:
        """That release runs, every start runs it, and nothing is half done."""
        states = self.states()
        assert [one for one, state in states.items() if state in ("current", "trial")] == [release]
        assert (self.running(), self.cell.show("ActiveState")) == (release, "active")
        assert not self.trial.exists()
        assert not list(self.path.glob(".*"))
        self.check_whole()

    def end(self) -> None:
        """Leave nothing of all this."""
        self.cell.doractl("disable", self.cell.name, check=False)
        self.cell.end()
        for path in (self.trial, ETC / self.cell.unit):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.path, ignore_errors=True)
        (STORE / f".{self.cell.name}.lock").unlink(missing_ok=True)
        run("systemctl", "daemon-reload")

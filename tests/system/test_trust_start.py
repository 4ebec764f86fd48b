"""Root starts what mallory owns: she gets nothing by it that is root's or somebody else's."""

import os
import pwd
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, run, wait_for
from tests.system.refusals import units

pytestmark = pytest.mark.lab

NODE = """
from dora import Node
for event in Node():
    pass
"""
FLOW = "nodes: [{id: a, path: a.py, inputs: {t: dora/timer/millis/50}}]\n"
MODULE = "module: {name: m}\n" + FLOW
SPY = """#!/bin/sh
{ echo "uid $(id -u)"; env; } >>{root}/proof
exec {dora} "$@"
"""


class Home:
    """A project in the home directory of an ordinary user, all of it hers."""

    def __init__(self, user: str) -> None:
        self.user = user
        run("useradd", "--create-home", user, check=False)
        entry = pwd.getpwnam(user)
        self.uid, self.root = entry.pw_uid, Path(entry.pw_dir, "project")
        self.root.mkdir()
        Path(entry.pw_dir).chmod(0o755)
        os.chown(self.root, self.uid, self.uid)
        self.write("a.py", NODE)

    def write(self, name: str, text: str, mode: int = 0o644) -> Path:
        """Write a file that is hers."""
        path = self.root / name
        path.write_text(text)
        path.chmod(mode)
        os.chown(path, self.uid, self.uid)
        return path

    def spy(self) -> Path:
        """A dora of hers that notes who runs it with what."""
        text = SPY.replace("{root}", str(self.root)).replace("{dora}", shutil.which("dora") or "")
        self.write("spy", text, 0o755)
        self.write("dataflow.systemd.yml", "dora: ./spy\nsandbox: none\n")
        return self.write("proof", "", 0o666)


@pytest.fixture
def mallory() -> Iterator[Home]:
    home = Home("mallory")
    yield home
    shutil.rmtree(home.root)


@pytest.fixture
def alices() -> Iterator[Home]:
    home = Home("alice")
    yield home
    shutil.rmtree(home.root)


def refused(cell: Cell, flow: Path, *words: str) -> str:
    """What `start` and `start --dry-run` say against it, in two lines and without a trace."""
    before = units()
    for more in ((), ("--dry-run",)):
        done = cell.start(flow, *words, *more, check=False)
        assert done.returncode in (ExitCode.BAD_INPUT, ExitCode.NO_PERMISSION), done.stderr
        assert len(done.stderr.splitlines()) == 2, done.stderr
    assert units() == before
    return done.stderr


def test_her_dora_never_runs_as_root(cell: Cell, mallory: Home) -> None:
    """A1, A8: not by any verb, and never with what stands in root's environment."""
    proof = mallory.spy()
    mallory.write("mod.yml", MODULE)
    flow = mallory.write("dataflow.yml", "nodes: [{id: m, module: mod.yml}]\n")
    os.environ["PRIVATE_OF_ROOT"] = "yes"
    try:
        cell.start(flow, "--dry-run")
        cell.start(flow)
        cell.doractl("set", cell.name, "--node-limit", "m.a:tasks=500", check=False)
        cell.doractl("dora", cell.name, "list")
        cell.doractl("stop", cell.name)
    finally:
        del os.environ["PRIVATE_OF_ROOT"]
    text = proof.read_text()
    who = {line for line in text.splitlines() if line.startswith("uid ")}
    assert who == {f"uid {mallory.uid}"}
    assert "PRIVATE_OF_ROOT" not in text
    assert "/root" not in text


def test_a_gateway_runs_no_dora_of_hers(cell: Cell, mallory: Home) -> None:
    """A1: nor does root's gateway, when it is asked about a node of hers."""
    from dora_systemd.adapters.bus.systemd import Bus
    from dora_systemd.gateway.control.state import ended_descriptor
    from dora_systemd.verbs.facts.cells import read_cell

    proof = mallory.spy()
    mallory.write("mod.yml", MODULE)
    flow = mallory.write("dataflow.yml", "nodes: [{id: m, module: mod.yml}]\n")
    cell.start(flow)
    found = read_cell(Bus(cell.scope), cell.unit)
    assert found is not None
    assert ended_descriptor(cell.scope, found.uuid)[0] == cell.name
    assert "uid 0" not in proof.read_text()


def test_a_link_lends_no_identity(cell: Cell, mallory: Home, alices: Home) -> None:
    """A2: neither alice's, nor that of root's dataflows."""
    own = mallory.root / "dataflow.yml"
    own.symlink_to(alices.write("dataflow.yml", FLOW))
    assert "symbolic link" in refused(cell, own)
    assert "symbolic link" in refused(cell, own, "--uid", "alice")
    own.unlink()
    roots = Path("/srv/roots.yml")
    roots.write_text(FLOW)
    own.symlink_to(roots)
    assert "symbolic link" in refused(cell, own)
    own.unlink()
    shutil.move(roots, own)
    assert own.stat().st_uid == 0
    assert "--uid" in refused(cell, own)
    assert "User=bob" in cell.start(own, "--dry-run", "--uid", "bob").stdout
    own.unlink()


def test_the_directory_has_to_be_of_the_same_owner(cell: Cell, mallory: Home, alices: Home) -> None:
    """A2: the programs of alice's dataflow are alice's."""
    flow = alices.write("dataflow.yml", FLOW)
    words = ("--working-directory", str(mallory.root))
    assert "--uid" in refused(cell, flow, *words)
    assert "User=alice" in cell.start(flow, "--dry-run", *words, "--uid", "alice").stdout
    alices.root.chmod(0o777)
    assert "--uid" in refused(cell, flow)


def test_a_link_lends_no_trust(cell: Cell, mallory: Home) -> None:
    """A3: settings are believed by the owner of what was read."""
    secret = Path("/root/token")
    secret.write_text("secret")
    secret.chmod(0o600)
    flow = mallory.write("dataflow.yml", FLOW)
    beside = mallory.root / "dataflow.systemd.yml"
    roots = Path("/srv/roots.systemd.yml")
    roots.write_text(f"credentials: {{token: {secret}}}\n")
    beside.symlink_to(roots)
    assert "symbolic link" in refused(cell, flow)
    beside.unlink()
    shutil.move(roots, beside)
    assert "credentials" in refused(cell, flow)
    beside.unlink()
    mallory.write("dataflow.systemd.yml", "cpu_weight: 10000\n")
    assert "cpu_weight" in refused(cell, flow)


def test_her_environment_file_is_read_as_her(cell: Cell, mallory: Home) -> None:
    """A4: what root may read does not get into her unit."""
    secret = Path("/root/secret.env")
    secret.write_text("SECRET=x\n")
    secret.chmod(0o600)
    flow = mallory.write("dataflow.yml", FLOW)
    mallory.write("dataflow.systemd.yml", f"env_file: {secret}\n")
    assert "permission denied" in refused(cell, flow)
    os.mkfifo(mallory.root / "pipe")
    mallory.write("dataflow.systemd.yml", "env_file: pipe\n")
    assert "regular file" in refused(cell, flow)
    own = mallory.write("own.env", "OWN=1\n", 0o600)
    mallory.write("dataflow.systemd.yml", f"env_file: {own}\n")
    text = cell.start(flow, "--dry-run", "--env-file", str(secret)).stdout
    assert "OWN=1" in text
    assert "SECRET=x" in text


def test_the_files_to_watch_are_not_walked_as_root(cell: Cell, mallory: Home) -> None:
    """A FIFO as .gitignore stops neither root's start nor her own runner."""
    flow = mallory.write("dataflow.yml", FLOW)
    os.mkfifo(mallory.root / ".gitignore")
    cell.start(flow, "--hot-reload", "--watch", "*.nothing", "--dry-run")
    cell.start(flow, "--hot-reload", "--watch", "*.nothing,*.py")
    count = len(cell.events())
    mallory.write("a.py", NODE + "\n")
    wait_for("a reload", lambda: ("node-reloaded", "a") in cell.events()[count:])


def test_what_is_there_is_not_told(cell: Cell, mallory: Home) -> None:
    """What she names is looked at with her eyes: root's directories are closed for her."""
    flow = mallory.write("dataflow.yml", FLOW)
    Path("/root/there/bin").mkdir(parents=True, exist_ok=True)
    Path("/root/there/bin/python").touch()
    for key in ("writable", "working_directory", "venv", "dora"):
        words = []
        for path in ("/root/there", "/root/nowhere"):
            mallory.write("dataflow.systemd.yml", f"{key}: {path}\n")
            done = cell.start(flow, "--dry-run", check=False)
            words.append((done.returncode, done.stderr.replace(path, "PATH")))
        assert words[0] == words[1], key
        assert words[0][0] != 0

"""Root starts what mallory owns: she gets nothing by it that is root's or somebody else's."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, wait_for
from tests.system.homes import FLOW, NODE, Home
from tests.system.refusals import units

pytestmark = pytest.mark.lab

MODULE = "module: {name: m}\n" + FLOW


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
        cell.doractl("set", cell.name, "--node", "m.a:tasks_limit=500", check=False)
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
    cell.end()  # before her files go, which it would notice


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

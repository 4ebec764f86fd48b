"""doractl deploy as root, of a project whose owner means harm."""

import os
import pwd
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.lab.pace import bound
from tests.system.cells import run
from tests.system.homes import FLOW, Home
from tests.system.releases import Releases

pytestmark = pytest.mark.lab

SPY = "#!/bin/sh\nid -u >>{proof}\ncat\n"


@pytest.fixture
def eve() -> Iterator[Home]:
    home = Home("eve")
    home.write("dataflow.yml", FLOW)
    yield home
    shutil.rmtree(home.root)


def as_owner(home: Home, *command: str) -> None:
    """Run a command in the project as its owner."""
    entry = pwd.getpwuid(home.uid)
    subprocess.run(
        command,
        cwd=home.root,
        user=home.uid,
        group=entry.pw_gid,
        env={"HOME": entry.pw_dir, "PATH": os.environ["PATH"]},
        check=True,
        capture_output=True,
    )


def test_root_reads_and_runs_nothing_of_hers(releases: Releases, eve: Home) -> None:
    proof = eve.write("proof", "", 0o666)
    spy = eve.write("spy", SPY.format(proof=proof), 0o755)
    eve.write(".gitattributes", "*.py filter=spy\n")
    eve.write(".gitignore", "proof\n")
    as_owner(eve, "git", "init", "-q")
    for key in ("core.fsmonitor", "filter.spy.clean", "filter.spy.process", "core.sshCommand"):
        as_owner(eve, "git", "config", key, str(spy))
    for hook in ("post-index-change", "pre-commit"):
        shutil.copy(spy, eve.root / ".git/hooks" / hook)
    releases.deploy(eve.root, "--soak", "0s")
    assert "0" not in proof.read_text().split()
    tree = releases.path / releases.current() / "tree"
    assert (tree / "a.py").exists()
    assert not (tree / "proof").exists()
    assert not (tree / ".git").exists()
    assert releases.cell.show("User") == "eve"
    # Other users see nothing of her project, and she cannot change it.
    assert (tree.parent.stat().st_mode & 0o777, tree.parent.stat().st_uid) == (0o750, 0)
    denied = run("runuser", "-u", "bob", "--", "ls", str(tree), check=False)
    assert denied.returncode != 0
    denied = run("runuser", "-u", "eve", "--", "touch", str(tree / "a.py"), check=False)
    assert denied.returncode != 0
    releases.check_whole()


def test_what_she_leaves_around_is_not_roots(releases: Releases, eve: Home) -> None:
    """Modules with the names of ours beside the dataflow, a virtual environment, uv and its index.

    doractl is called in the project, as people do.
    """
    proof = eve.write("proof", "", 0o666)
    spy = f"import os\nopen('{proof}', 'a').write(f'{{os.getuid()}}\\n')\n"
    for name in ("sitecustomize", "usercustomize", "json", "yaml", "click", "dora_systemd"):
        eve.write(f"{name}.py", spy)
    (eve.root / ".venv/bin").mkdir(parents=True)
    eve.write(".venv/pyvenv.cfg", "home = /usr/bin\n")
    for name in ("dora", "python", "python3", "uv", "git"):
        program = SPY.format(proof=proof).replace("cat", f'exec {shutil.which(name)} "$@"')
        eve.write(f".venv/bin/{name}", program, 0o755)
    index = 'index-url = "http://127.0.0.1:9/"\n'
    eve.write("uv.toml", index)
    eve.write("pyproject.toml", f"[project]\nname='x'\nversion='1'\n[tool.uv]\n{index}")
    eve.write("uv.lock", "version = 1\n")
    cell = releases.cell
    words = (*("deploy", ".", "--name", cell.name, "--soak", "0s"), "--no-hot-reload")
    environment = {**os.environ, "VIRTUAL_ENV": str(eve.root / ".venv")}
    done = run("doractl", "--system", *words, cwd=eve.root, env=environment, check=False)
    assert "0" not in proof.read_text().split(), done.stderr
    proof.write_text("")
    # By its user nothing but her nodes and her dora have run.
    run("doractl", "--system", *words, "--dry-run", cwd=eve.root, env=environment, check=False)
    assert "0" not in proof.read_text().split()


def test_a_million_files_in_an_index(releases: Releases, eve: Home) -> None:
    """They are refused by their number, and nobody looks for each of them."""
    as_owner(eve, "git", "init", "-q")
    blob = "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391"
    lines = (f"100644 {blob}\tmany/{number:06x}" for number in range(1_000_000))
    index = eve.write("index", "\n".join(lines))
    as_owner(eve, "sh", "-c", "git update-index --index-info <index")
    index.unlink()
    begun = time.monotonic()
    assert "more than 100000 files" in releases.deploy(eve.root, status=5)
    assert time.monotonic() - begun < bound(20)
    assert not releases.path.exists()


def test_what_a_release_must_not_have(releases: Releases, eve: Home) -> None:
    def refused(words: str, status: int = 5) -> None:
        assert words in releases.deploy(eve.root, status=status)
        assert not releases.path.exists() or not list(releases.path.iterdir())

    secret = Path("/home/secret")
    secret.write_text("of root")
    secret.chmod(0o600)
    try:
        (eve.root / "hard").hardlink_to(secret)
        refused("as user eve: Permission denied")
    finally:
        secret.unlink()
        (eve.root / "hard").unlink()
    for target in (str(secret), "../../other", "a/../../../etc"):
        (eve.root / "link").symlink_to(target)
        refused("cannot copy link: it links to")
        (eve.root / "link").unlink()
    os.mkfifo(eve.root / "fifo")
    refused("cannot copy fifo: it is a FIFO")
    (eve.root / "fifo").unlink()
    for name in (b"new\nline", b"not\xffutf8"):
        path = os.fsencode(eve.root) + b"/" + name
        os.close(os.open(path, os.O_CREAT))
        refused("its name is not printable text")
        os.unlink(path)  # noqa: PTH108 - a Path has no bytes
    sparse = eve.write("sparse", "")
    os.truncate(sparse, 10 * 1024**3)
    refused("a release has at most 4G")
    sparse.unlink()
    settings = eve.write("dataflow.systemd.yml", "user: root\n")
    refused("user is set there", 8)
    settings.unlink()

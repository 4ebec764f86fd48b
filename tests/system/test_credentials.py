"""Credentials: a node reads the secret, and nobody finds it anywhere else."""

import json
import os
import pwd
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope
from tests.system.cells import Cell, Project, journalctl, run, wait_for
from tests.system.refusals import Refusal, check_refusals

SECRET = "correct-horse-battery-staple"
READER = """
import os, hashlib
from dora import Node
node = Node()
directory = os.environ["CREDENTIALS_DIRECTORY"]
text = open(directory + "/token").read()
print("read", len(text), hashlib.sha256(text.encode()).hexdigest()[:8], flush=True)
for event in node:
    pass
"""
FLOW = "nodes: [{id: reader, path: reader.py, inputs: {t: dora/timer/millis/100}}]\n"


@pytest.fixture
def token(project: Project) -> Path:
    """A file that only root reads."""
    path = project.write("token", SECRET)
    path.chmod(0o600)
    return path


def flow_of(project: Project) -> Path:
    project.write("reader.py", READER)
    return project.write("dataflow.yml", FLOW)


def wait_read(cell: Cell, times: int) -> None:
    wait_for("the node reads it", lambda: len(cell.messages("reader")) == times)
    assert {one.split()[1] for one in cell.messages("reader")} == {str(len(SECRET))}


def environments() -> Iterator[str]:
    """Command line and variables of every process."""
    for path in Path("/proc").glob("[0-9]*"):
        for name in ("environ", "cmdline"):
            try:
                yield (path / name).read_text(errors="replace")
            except OSError:
                continue


def assert_hidden(cell: Cell, token: Path) -> None:
    # Since the file is there: what other tests have logged before takes a minute to print.
    journal = journalctl("-o", "json", "--all", "-S", f"@{token.stat().st_mtime:.6f}")
    assert cell.unit in journal
    for text in (
        cell.doractl("show", cell.name).stdout,
        cell.doractl("export", cell.name).stdout,
        cell.doractl("list", cell.name, "-o", "json").stdout,
        cell.systemctl("show"),
        cell.systemctl("cat"),
        run("ps", "axeww").stdout,
        journal,
        *environments(),
    ):
        assert SECRET not in text
    for path in Path("/run/dora-systemd").rglob("*"):
        assert not path.is_file() or SECRET.encode() not in path.read_bytes()


@pytest.mark.lab
def test_a_node_reads_what_nobody_else_finds(cell: Cell, project: Project, token: Path) -> None:
    beside = project.write("dataflow.systemd.yml", "credentials: {token: token}\n")
    cell.start(flow_of(project))
    wait_read(cell, 1)
    assert f"LoadCredential=token:{token}" in cell.doractl("show", cell.name).stdout
    assert_hidden(cell, token)
    # Another user cannot look into the directory.
    (pid,) = cell.pids("node-reader")
    words = Path(f"/proc/{pid}/environ").read_text().split("\0")
    directory = next(one for one in words if one.startswith("CREDENTIALS_DIRECTORY=")).split("=")[1]
    other = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "cat"]
    assert run(*other, f"/proc/{pid}/root{directory}/token", check=False).returncode
    assert run(*other, f"{directory}/token", check=False).returncode
    beside.unlink()
    cell.doractl("restart", cell.name)
    wait_read(cell, 2)


@pytest.mark.lab
def test_a_unit_file_has_it_too(cell: Cell, project: Project, token: Path) -> None:
    cell.start(flow_of(project), "--credential", f"token={token}", "--enable")
    try:
        wait_read(cell, 1)
        assert_hidden(cell, token)
        cell.systemctl("restart")
        wait_read(cell, 2)
    finally:
        cell.doractl("disable", cell.name)


@pytest.mark.lab
@pytest.mark.warns("credentials", "CREDENTIALS", "Failed to start", "Failed with result")
def test_a_file_that_has_gone(cell: Cell, project: Project, token: Path) -> None:
    cell.start(flow_of(project), "--credential", f"token={token}")
    token.unlink()
    done = cell.doractl("restart", cell.name, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert f"cannot use {token} as credential token: there is no such file" in done.stderr
    assert cell.show("ActiveState") == "active"
    done = cell.doractl("restart", cell.name, "--force", check=False)
    assert done.returncode == ExitCode.FAILURE
    assert "a credential could not be read (exit code 243/CREDENTIALS)" in done.stderr


@pytest.mark.lab
def test_user_scope(project: Project) -> None:
    alice = pwd.getpwnam("alice")
    wait_for("her manager", lambda: Path(f"/run/user/{alice.pw_uid}/bus").exists())
    token = project.write("token", SECRET)
    token.chmod(0o600)
    os.chown(token, alice.pw_uid, alice.pw_gid)
    hers = Cell("hers", Scope(is_user=True, uid=alice.pw_uid))
    become = ("runuser", "-u", "alice", "--", "env", f"XDG_RUNTIME_DIR=/run/user/{alice.pw_uid}")
    words = ("start", str(flow_of(project)), "--name", "hers", "--credential", f"token={token}")
    try:
        run(*become, "doractl", *words)
        journal = ("-o", "json", f"_UID={alice.pw_uid}", "DORA_NODE=reader")

        def read() -> list[str]:
            lines = journalctl(*journal, "DORA_DATAFLOW_NAME=hers").splitlines()
            return [m for m in (json.loads(one)["MESSAGE"] for one in lines) if m[:4] == "read"]

        wait_for("the node reads it", read)
        assert read()[0].split()[1] == str(len(SECRET))
        shown = run(*become, "doractl", "show", hers.name).stdout
        assert f"LoadCredential=token:{token}" in shown
        for text in (shown, run("ps", "axeww").stdout, *environments()):
            assert SECRET not in text
    finally:
        run(*become, "doractl", "stop", hers.name)


def test_what_is_refused(cell: Cell, project: Project) -> None:
    flow = str(flow_of(project))
    bad = ExitCode.BAD_INPUT
    check_refusals(
        cell,
        project,
        [
            Refusal([flow, "--credential=token"], ExitCode.USAGE, "NAME=FILE"),
            Refusal([flow, "--credential=a/b=/etc/passwd"], ExitCode.USAGE, "'a/b'"),
            Refusal([flow, "--credential=a=/nowhere"], bad, "there is no such file"),
            Refusal([flow, f"--credential=a={project.root}"], bad, "it is a directory"),
            Refusal([flow, "--env=CREDENTIALS_DIRECTORY=/"], ExitCode.USAGE, "systemd sets"),
        ],
    )

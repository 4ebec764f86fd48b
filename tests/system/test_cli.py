"""The command line of doractl where it meets systemd."""

import json
import subprocess
import sys

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run


def as_user(user: str, words: str) -> "subprocess.CompletedProcess[str]":
    return run("su", user, "-s", "/bin/sh", "-c", f"exec doractl {words}", check=False)


def test_version() -> None:
    versions = json.loads(run("doractl", "version", "-o", "json").stdout)
    assert versions["python"] == ".".join(map(str, sys.version_info[:3]))
    assert versions["systemd"].split(".")[0] in run("systemctl", "--version").stdout
    assert versions["dora"].startswith("1.")


@pytest.mark.lab
def test_scope_before_and_after_the_verb() -> None:
    for words in ("--system list", "list --system", "--user list --system"):
        assert as_user("alice", words).returncode == 0
    assert as_user("alice", "list").returncode == 0


@pytest.mark.lab
def test_no_user_manager() -> None:
    for words in (["list"], ["--user", "stop", "x"], ["start", "--user", "/nowhere.yml"]):
        done = run("doractl", "--user", *words, check=False)
        assert done.returncode == ExitCode.NO_SYSTEMD
        assert done.stderr.startswith("doractl: cannot reach the systemd of this user")
        assert "enable-linger root" in done.stderr


@pytest.mark.lab
def test_system_scope_is_roots(project: Project) -> None:
    flow = project.three_nodes()
    done = as_user("alice", f"--system start {flow} --name hers")
    assert done.returncode == ExitCode.NO_PERMISSION
    assert "--user" in done.stderr
    assert (
        run("systemctl", "show", "--value", "-p", "LoadState", "dora-hers").stdout == "not-found\n"
    )


def test_a_pipe_that_closes(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    shell = f"doractl list {cell.name} | head -n 1"
    done = run("bash", "-c", shell)
    assert done.stdout.startswith("Dataflow: ")
    assert done.stderr == ""

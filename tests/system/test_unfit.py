"""Machines on which no dataflow can run: one line, a hint that says what to do, and no change.

Elsewhere: a dora that is too old and programs of another processor (test_start_refused.py), systemd
below 252 (tests/unit/decisions/unit/test_systemd_versions.py), Python below 3.11
(tests/unit/words/test_python.py).
"""

import json
import pwd
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.refusals import files_of, units

# Mounts, and users that are made and removed.
pytestmark = pytest.mark.lab

NO_INIT = "mount -t tmpfs none /run; mount -t tmpfs none /var/log"
KERNEL = "/proc/sys/kernel/osrelease"
WITHOUT_SYSTEMD = {
    "chroot": (NO_INIT, "this machine was not booted with systemd: make it the init system"),
    "container": (
        f"{NO_INIT}; touch /run/.containerenv",
        "this container runs no systemd: boot it with /sbin/init, as podman run --systemd=always",
    ),
    "wsl": (
        f"{NO_INIT}; echo 6.6.87-microsoft-standard-WSL2 >/run/k; mount --bind /run/k {KERNEL}",
        "WSL starts systemd only if told to: write systemd=true below [boot] in /etc/wsl.conf",
    ),
}
"""What hides systemd from a command, and how the hint begins."""
OF_A_DATAFLOW = ("start", "run", "deploy", "start --dry-run")
OF_A_NAME = ("stop", "restart", "enable", "list", "why", "logs", "show", "reload", "rollback")
OF_ALL = ("list", "top", "up", "env", "destroy", "inhibit")
NO_CGROUPS = "mount -t tmpfs none /sys/fs/cgroup"


def behind(script: str, *words: str) -> CompletedProcess[str]:
    """doractl in a mount namespace that the script has changed."""
    shell = ("unshare", "--mount", "sh", "-euc", f'{script}; exec "$@"', "sh")
    return run(*shell, *words, check=False)


def refuse(script: str, code: ExitCode, line: str, hint: str, *words: str) -> None:
    done = behind(script, "doractl", *words)
    lines = done.stderr.splitlines()
    assert len(lines) == 2, (words, lines)
    assert lines[0].startswith(f"doractl: {line}"), (words, lines)
    assert lines[1].startswith(f"hint: {hint}"), (words, lines)
    assert (done.returncode, done.stdout) == (code, ""), (words, done.stdout)


@pytest.fixture
def flow(project: Project) -> Iterator[str]:
    """A dataflow of which nothing is left behind."""
    path = project.three_nodes()
    places = (project.root, Path("/run/dora-systemd"), Path("/etc/systemd/system"))
    before = files_of(*places), units()
    yield str(path)
    assert (files_of(*places), units()) == before


@pytest.mark.parametrize("kind", WITHOUT_SYSTEMD)
def test_without_systemd(kind: str, flow: str) -> None:
    script, hint = WITHOUT_SYSTEMD[kind]
    lines = [(*line.split(), flow) for line in OF_A_DATAFLOW]
    lines += [*((verb, "robot") for verb in OF_A_NAME), *((verb,) for verb in OF_ALL)]
    for words in lines:
        refuse(script, ExitCode.NO_SYSTEMD, "cannot ", hint, *words)
    found = json.loads(behind(script, "doractl", "doctor", "-o", "json").stdout)
    assert (found[0]["state"], found[0]["remedy"][: len(hint)]) == ("problem", hint)


def test_without_cgroup_v2(flow: str) -> None:
    line = "cannot find the cgroup v2 hierarchy below /sys/fs/cgroup"
    hint = "boot with systemd.unified_cgroup_hierarchy=1 on the command line of the kernel"
    for verb in ("start", "run", "start --enable"):
        refuse(NO_CGROUPS, ExitCode.NO_SYSTEMD, line, hint, *verb.split(), flow)
    done = behind(NO_CGROUPS, "doractl", "doctor", "-o", "json")
    (found,) = [one for one in json.loads(done.stdout) if one["topic"] == "cgroup"]
    assert (found["state"], found["text"], found["remedy"]) == ("problem", line, hint)
    assert done.returncode == ExitCode.FAILURE


def test_without_dora(flow: str) -> None:
    places = filter(None, (shutil.which("dora"), "/usr/bin/dora"))
    there = [path for path in dict.fromkeys(places) if Path(path).exists()]
    script = "; ".join(f"mount --bind /dev/null {path}" for path in there)
    hint = "pip install dora-rs-cli, install the package dora-cli, or give --dora PATH"
    for verb in ("start", "run", "start --dry-run", "start --enable"):
        line = "cannot find the dora command"
        refuse(script, ExitCode.NO_DORA, line, hint, *verb.split(), flow)


def test_from_a_directory_that_was_removed(cell: Cell, project: Project) -> None:
    """A file that is named by its whole path needs none."""
    flow, gone = str(project.three_nodes()), 'd=$(mktemp -d); cd "$d"; rmdir "$d"'
    assert behind(gone, "doractl", "start", flow, "--name", cell.name).returncode == 0
    assert cell.doractl("list", cell.name).stdout
    line = "cannot read dataflow.yml: the current directory was removed"
    refuse(gone, ExitCode.BAD_INPUT, line, "cd to a directory that exists", "start")


@pytest.fixture(params=["--user-group", "--system"])
def carol(request: pytest.FixtureRequest) -> Iterator[pwd.struct_passwd]:
    """A person who never logs in, or the account of a program: as cron runs their commands."""
    run("useradd", "--create-home", request.param, "carol")
    yield pwd.getpwnam("carol")
    run("loginctl", "disable-linger", "carol")
    run("loginctl", "terminate-user", "carol", check=False)
    wait_for("its end", lambda: run("userdel", "--remove", "carol", check=False).returncode == 0)


def as_cron(user: pwd.struct_passwd, *words: str) -> CompletedProcess[str]:
    """A command of the user without a session, and with the variables of cron."""
    switch = ("setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--init-groups")
    plain = ("env", "--ignore-environment", f"HOME={user.pw_dir}", "LOGNAME=carol")
    path = f"PATH={Path(shutil.which('doractl') or '').parent}:/usr/bin:/bin"
    return run(*switch, *plain, path, *words, check=False)


def test_without_a_manager_of_the_user(carol: pwd.struct_passwd, flow: str) -> None:
    for words in (("list",), ("start", flow), ("stop", "robot"), ("up",)):
        done = as_cron(carol, "doractl", *words)
        first, second = done.stderr.splitlines()
        assert first == "doractl: cannot reach the systemd of this user: No such file or directory"
        assert (done.returncode, done.stdout) == (ExitCode.NO_SYSTEMD, ""), words
    (remedy,) = re.findall(r"loginctl .*", second)
    run(*remedy.split())
    socket = Path(f"/run/user/{carol.pw_uid}/systemd/private")
    wait_for("the manager", socket.exists)
    assert as_cron(carol, "doractl", "list").stdout

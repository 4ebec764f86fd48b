"""doractl deploy, releases and rollback: what runs is whole, and has proved itself."""

import fcntl
import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.lab.pace import pace
from tests.system.cells import Project, run, wait_for
from tests.system.releases import FLOW, STORE, Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

FAST = ("--soak", "0s")
ETC = Path("/etc/systemd/system")


def test_a_release_runs_and_is_not_what_it_was_copied_from(
    releases: Releases, project: Project
) -> None:
    flow, cell = write_version(project, "1"), releases.cell
    said = releases.deploy(project.root, "--soak", "1s")
    first = releases.current()
    assert f"Release: {first}" in said
    assert releases.running() == first
    assert cell.show("FragmentPath") == str(ETC / cell.unit)
    assert cell.show("UnitFileState") == "enabled"
    assert not releases.trial.exists()
    write_version(project, "half a cop")
    (row,) = json.loads(cell.doractl("releases", cell.name, "-o", "json").stdout)
    assert {*row["versions"]} == {"doractl", "dora", "python", "systemd"}
    assert row["versions"]["dora"].startswith("1.")
    cell.systemctl("restart")
    assert cell.messages("a") == ["version 1", "version 1"]
    refused = cell.doractl("reload", cell.name, check=False)
    assert (refused.returncode, "doractl deploy" in refused.stderr) == (2, True)
    changed = cell.doractl("deploy", str(flow), "--name", cell.name, "--dry-run").stdout
    assert changed == "~ a.py\n"
    # The next one shares what has not changed, and keeps the UUID.
    write_version(project, "2")
    said += releases.deploy(flow, *FAST)
    assert len({line for line in said.splitlines() if line.startswith("Dataflow deployed")}) == 1
    trees = [releases.path / one / "tree/dataflow.yml" for one in releases.states()]
    assert len({tree.stat().st_ino for tree in trees}) == 1
    releases.check_whole()
    # And back again.
    cell.doractl("rollback", cell.name)
    assert (releases.current(), releases.running()) == (first, first)
    assert sorted(releases.states().values()) == ["current", "proved"]
    assert f"Release:  {first}" in cell.doractl("list", cell.name).stdout


BAD = {
    "it does not compile": ("def (:\n", "node a: exit code 1"),
    "a module is missing": ("import nothing_of_that_name\n", "node a: exit code 1"),
    "it crashes while it soaks": (
        "import os, threading\nthreading.Timer(1, os._exit, (7,)).start()\n",
        "node a: exit code 7",
    ),
}


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_bad_versions_are_undone(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "good")
    releases.deploy(project.root, *FAST)
    good = releases.current()
    for how, (before, reason) in BAD.items():
        write_version(project, how, before)
        said = releases.deploy(project.root, "--soak", "20s", status=11)
        assert f"was rolled back: {reason}" in said, how
        assert f"hint: {good} runs again" in said
        assert (releases.current(), releases.running()) == (good, good)
        assert not releases.trial.exists()
    assert list(releases.states().values()) == ["unproved"] * 3 + ["current"]
    why = cell.doractl("why", cell.name).stdout
    assert "node a: exit code 7" in why.partition("Undone:")[2].splitlines()[0]
    releases.check_whole()


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_a_first_version_that_is_bad_leaves_nothing_running(
    releases: Releases, project: Project
) -> None:
    write_version(project, "bad", "raise SystemExit(3)\n")
    said = releases.deploy(project.root, status=11)
    assert "node a: exit code 3" in said
    assert "nothing of it runs" in said
    assert (releases.running(), list(releases.states().values())) == ("", ["unproved"])
    assert not (ETC / releases.cell.unit).exists()
    assert not releases.trial.exists()


REFUSED = {
    "dora refuses": ("nodes: [{id: a, path: a.py, unknown: 3}]", "unknown field"),
    "missing": ("nodes: [{id: a, path: gone.py}]", "gone.py"),
    "build": ("nodes: [{id: a, path: a.py, build: touch /proof}]", "build"),
    "git": ("nodes: [{id: a, path: a.py, git: https://localhost/a.git}]", "git"),
}


def test_what_cannot_run_is_refused_while_the_old_one_runs(
    releases: Releases, project: Project
) -> None:
    cell = releases.cell
    write_version(project, "good")
    releases.deploy(project.root, *FAST)
    life, known = cell.show("InvocationID"), releases.states()
    for text, reason in REFUSED.values():
        project.write("dataflow.yml", text)
        said = releases.deploy(project.root, status=5)
        assert reason in said
        assert str(STORE) not in said
    project.write("dataflow.yml", FLOW)
    assert "hot reload is on" in releases.deploy(project.root, "--hot-reload", status=5)
    (project.root / "link").symlink_to("/etc/shadow")
    assert "cannot copy link" in releases.deploy(project.root, status=5)
    # Somebody else is at it.
    (project.root / "link").unlink()
    with locked(STORE / f".{cell.name}.lock"):
        assert "another deploy" in releases.deploy(project.root, status=1)
    assert (cell.show("InvocationID"), releases.states()) == (life, known)
    assert not Path("/proof").exists()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """What another deploy holds."""
    fd = os.open(path, os.O_RDONLY)
    fcntl.flock(fd, fcntl.LOCK_EX)
    yield
    os.close(fd)


def test_a_full_disk_changes_nothing(releases: Releases, project: Project) -> None:
    write_version(project, "good")
    releases.path.mkdir(parents=True)
    run("mount", "-t", "tmpfs", "-o", "size=200k", "none", str(releases.path))
    try:
        releases.deploy(project.root, *FAST)
        life, known = releases.cell.show("InvocationID"), releases.states()
        project.write("model.bin", "x" * 1_000_000)
        assert "No space left on device" in releases.deploy(project.root, status=1)
        assert (releases.cell.show("InvocationID"), releases.states()) == (life, known)
        assert not list(releases.path.glob(".*"))
        releases.check_whole()
    finally:
        releases.cell.end()
        run("umount", "--lazy", str(releases.path))


def begin(releases: Releases, project: Project, soak: str) -> "subprocess.Popen[bytes]":
    """A deploy that goes on."""
    cell = releases.cell
    command = ("doractl", "--system", "deploy", str(project.root), "--name", cell.name)
    return subprocess.Popen([*command, "--soak", soak], stderr=subprocess.DEVNULL)


def test_an_interrupted_trial_is_undone(releases: Releases, project: Project) -> None:
    write_version(project, "good")
    releases.deploy(project.root, *FAST)
    good = releases.current()
    write_version(project, "next")
    with begin(releases, project, "1h") as child:
        wait_for("it runs", lambda: "version next" in releases.cell.messages("a"))
        assert "trial" in releases.states().values()
        child.send_signal(signal.SIGTERM)
        assert child.wait() == 11
    assert (releases.current(), releases.running()) == (good, good)
    assert not releases.trial.exists()


def test_a_first_trial_that_was_killed_can_be_ended(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "first")
    with begin(releases, project, "1h") as child:
        wait_for("it runs", lambda: "version first" in cell.messages("a"))
        child.kill()
    assert "trial" in releases.states().values()
    assert "its trial has ended" in cell.doractl("rollback", cell.name).stdout
    assert (releases.running(), list(releases.states().values())) == ("", ["unproved"])
    assert not releases.trial.exists()
    assert not (ETC / cell.unit).exists()
    again = cell.doractl("rollback", cell.name, check=False)
    assert (again.returncode, "no release before" in again.stderr) == (4, True)


ROUNDS = int(os.environ.get("ROUNDS", "6"))


def test_it_can_be_killed_at_any_moment(releases: Releases, project: Project) -> None:
    cell, chance = releases.cell, random.Random(ROUNDS)
    write_version(project, "0")
    releases.deploy(project.root, *FAST)
    for count in range(ROUNDS):
        write_version(project, str(count + 1))
        with begin(releases, project, "0s") as child:
            time.sleep(chance.uniform(0, 4 * pace()))  # the moment is what is tried
            child.kill()
        states, running = releases.states(), releases.running()
        assert list(states.values()).count("current") == 1
        assert not running or states[running] in ("current", "trial"), (count, states)
        wait_for("it runs", lambda: cell.show("ActiveState") == "active")
        releases.check_whole()
    releases.deploy(project.root, *FAST)
    assert not releases.trial.exists()
    assert not list(releases.path.glob(".*"))
    assert releases.running() == releases.current()

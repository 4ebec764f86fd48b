"""What is left of a trial whose doractl is killed with all around it, or just before it begins."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from dora_systemd.adapters.releases.store import Store, is_locked
from tests.system.cells import Project, journalctl, run, wait_for
from tests.system.releases import STORE, Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

JOB = "deploying.service"
_KILLED = """
import os, signal, sys
own = os.getpid()
def hook(event, arguments):
    if event == "open" and os.getpid() == own and ".control/" in str(arguments[0]):
        if arguments[2] & os.O_WRONLY:
            os.kill(own, signal.SIGKILL)
sys.addaudithook(hook)
from dora_systemd.cli.main import main
main()
"""
"""A doractl that is killed when it is about to write the unit file of the trial."""


@pytest.fixture
def good(releases: Releases, project: Project) -> str:
    """A release that runs, before the next version of the project."""
    write_version(project, "good")
    releases.deploy(project.root, "--soak", "0s")
    write_version(project, "next")
    return releases.current()


@pytest.fixture
def job(releases: Releases, project: Project, good: str) -> Iterator[str]:
    """A unit whose only command is a deploy, which is at its trial."""
    del good
    cell, doractl = releases.cell, shutil.which("doractl")
    words = ("deploy", str(project.root), "--name", cell.name, "--soak", "1h")
    unit = ("--quiet", "--collect", f"--unit={JOB}", "--setenv=PATH")
    run("systemd-run", *unit, str(doractl), "--system", *words)
    wait_for("it runs", lambda: "version next" in cell.messages("a"))
    yield JOB
    run("systemctl", "kill", "--signal=KILL", JOB, check=False)


def is_at_work(releases: Releases) -> bool:
    """Whether doractl, or its guard, holds the lock of the releases."""
    return is_locked(Store(STORE, releases.cell.name))


@pytest.mark.parametrize("number", ["QUIT", "ABRT"])
def test_a_signal_to_all_of_a_unit(number: str, releases: Releases, good: str, job: str) -> None:
    """As of KillSignal=: doractl dies of it, and what it leaves behind goes back."""
    run("systemctl", "kill", f"--signal={number}", job)
    wait_for("the way back", lambda: not is_at_work(releases))
    assert (releases.running(), releases.current()) == (good, good)
    assert not releases.trial.exists()


def test_kill_9_of_a_whole_unit_leaves_a_trial_that_can_be_ended(
    releases: Releases, good: str, job: str
) -> None:
    """As of a session that is ended by force; the manual says so."""
    run("systemctl", "kill", "--signal=KILL", job)
    wait_for("nobody is at it", lambda: not is_at_work(releases))
    assert "trial" in releases.states().values()
    assert "on trial" in releases.cell.doractl("doctor", check=False).stdout
    releases.cell.doractl("rollback", releases.cell.name)
    releases.check_only(good)


@pytest.mark.warns("killed", "SIGKILL", "Failed with", "failed: ", "rolled back")
@pytest.mark.usefixtures("job")
def test_what_stop_now_has_ended_does_not_start_again(releases: Releases, good: str) -> None:
    """Whoever stops a robot during a trial wants it to stand still."""
    cell = releases.cell
    cell.doractl("stop", "--now", cell.name)
    wait_for("the way back", lambda: not is_at_work(releases))
    assert (cell.show("ActiveState"), releases.current()) == ("inactive", good)
    assert "it was stopped" in journalctl("-u", JOB)


def test_killed_before_the_trial(releases: Releases, project: Project, good: str) -> None:
    """What runs is not touched."""
    cell = releases.cell
    life = cell.show("InvocationID")
    words = ("--system", "deploy", str(project.root), "--name", cell.name)
    done = subprocess.run([sys.executable, "-c", _KILLED, *words], check=False, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    wait_for("the guard has ended", lambda: not is_at_work(releases))
    assert (cell.show("InvocationID"), releases.running()) == (life, good)
    assert not releases.trial.exists()
    releases.deploy(project.root, "--soak", "0s")
    releases.check_only(releases.current())

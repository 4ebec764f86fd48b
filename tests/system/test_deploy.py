"""doractl deploy, releases and rollback: what runs is whole, and has proved itself."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.values import SECOND
from dora_systemd.verbs.releases.soak import START_LIMIT
from tests.system.cells import Project, run, wait_for
from tests.system.releases import ETC, FLOW, STORE, Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

FAST = ("--soak", "0s")
WRITES = 'import os; open(os.environ["STATE_DIRECTORY"] + "/runs", "a").write("1")\n'


def test_a_release_runs_and_is_not_what_it_was_copied_from(
    releases: Releases, project: Project
) -> None:
    cell, own = releases.cell, ("--property", f"StateDirectory={releases.cell.name}")
    flow = write_version(project, "1", WRITES)
    said = releases.deploy(project.root, "--soak", "1s", *own)
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
    write_version(project, "2", WRITES)
    said += releases.deploy(flow, *FAST, *own)
    assert len({line for line in said.splitlines() if line.startswith("Dataflow deployed")}) == 1
    trees = [releases.path / one / "tree/dataflow.yml" for one in releases.states()]
    assert len({tree.stat().st_ino for tree in trees}) == 1
    releases.check_whole()
    # And back again.
    cell.doractl("rollback", cell.name)
    assert (releases.current(), releases.running()) == (first, first)
    assert list(releases.states().values()) == ["rolled-back", "current"]
    words = "doractl", "--system", "releases", cell.name, "--history"
    other = run("runuser", "-u", "alice", "--", *words, check=False)
    assert (other.returncode, "hint: use sudo" in other.stderr) == (ExitCode.NO_PERMISSION, True)
    assert f"Release:  {first}" in cell.doractl("list", cell.name).stdout
    changed = cell.doractl("deploy", str(flow), "--name", cell.name, "--dry-run").stdout
    assert changed == "~ a.py\n", "it differs from what runs, and not from the newest one"
    state = Path("/var/lib", cell.name)
    assert (state / "runs").read_text() == "1111", "all of them have written to it"
    shutil.rmtree(state)


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_a_first_version_that_is_bad_leaves_nothing_running(
    releases: Releases, project: Project
) -> None:
    cell = releases.cell
    write_version(project, "bad", 'print("no camera", flush=True)\nraise SystemExit(3)\n')
    said = releases.deploy(project.root, status=11)
    assert "node a: exit code 3" in said
    assert "  a: no camera\n" in said
    assert "nothing of it runs" in said
    assert (releases.running(), list(releases.states().values())) == ("", ["failed"])
    assert not (ETC / cell.unit).exists()
    assert not releases.trial.exists()
    why = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    assert [line["text"] for line in why["last_lines"]] == ["no camera"]
    assert why["undone"]["node"] == "a"
    # And nothing of it is kept, if nobody wants it.
    asked = cell.doractl("forget", cell.name, check=False)
    assert (asked.returncode, "use --force" in asked.stderr) == (2, True)
    assert "Dataflow forgotten" in cell.doractl("forget", cell.name, "--force").stdout
    assert not releases.path.exists()
    wait_for("list does without", lambda: cell.name not in cell.doractl("list", "--all").stdout)
    again = cell.doractl("start", cell.name, check=False)
    assert (again.returncode, "no dataflow named" in again.stderr) == (4, True)


@pytest.mark.warns(
    "crashed", "failed", "Failed", "exited", "exit code", "error", "Error", "restart"
)
def test_a_version_that_dora_starts_again_and_again_is_no_wait(
    releases: Releases, project: Project
) -> None:
    """It is never ready and never failed: without a look at its crashes, two minutes."""
    flow = write_version(project, "bad", "raise SystemExit(3)\n")
    policy = "restart_policy: on-failure, max_restarts: 0, restart_delay: 0.1"
    project.write(flow.name, FLOW.replace("}]", f", {policy}}}]"))
    begun = time.monotonic()
    said = releases.deploy(project.root, status=11)
    assert "node a: exit code 3" in said
    assert time.monotonic() - begun < START_LIMIT / SECOND, "it has seen the crash, not the end"


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_after_a_start_that_has_failed_the_release_runs(
    releases: Releases, project: Project
) -> None:
    """systemd still has the ended unit, whose file leads to the project."""
    cell = releases.cell
    flow = write_version(project, "bad", "raise SystemExit(3)\n")
    cell.doractl("start", str(flow), "--name", cell.name, check=False)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    assert cell.show("Transient") == "yes"
    write_version(project, "good")
    releases.deploy(project.root, *FAST)
    current = releases.current()
    releases.check_only(current)
    assert cell.show("FragmentPath") == str(ETC / cell.unit)
    cell.systemctl("restart")
    assert releases.running() == current


REFUSED = {
    "dora refuses": ("nodes: [{id: a, path: a.py, unknown: 3}]", "unknown field"),
    "missing": ("nodes: [{id: a, path: gone.py}]", "gone.py"),
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
    (project.root / "link").symlink_to(STORE)
    assert "cannot copy link" in releases.deploy(project.root, status=5)
    # Somebody else is at it.
    (project.root / "link").unlink()
    with locked(STORE / f".{cell.name}.lock"):
        assert "another deploy" in releases.deploy(project.root, status=1)
    assert (cell.show("InvocationID"), releases.states()) == (life, known)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """What another deploy holds."""
    fd = os.open(path, os.O_RDONLY)
    fcntl.flock(fd, fcntl.LOCK_EX)
    yield
    os.close(fd)


@contextmanager
def begin(releases: Releases, project: Project, soak: str) -> Iterator["subprocess.Popen[bytes]"]:
    """A deploy that goes on, unless the context fails: nobody waits for its end then."""
    cell = releases.cell
    command = ("doractl", "--system", "deploy", str(project.root), "--name", cell.name)
    with subprocess.Popen([*command, "--soak", soak], stderr=subprocess.DEVNULL) as child:
        try:
            yield child
        except BaseException:
            child.kill()
            raise


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


def test_a_unit_on_trial_is_not_changed(releases: Releases, project: Project) -> None:
    """What the trial commits, or goes back to, would undo half of the change."""
    cell = releases.cell
    write_version(project, "next")
    with begin(releases, project, "1h") as child:
        wait_for("it runs", lambda: "version next" in cell.messages("a"))
        (release,) = releases.states()
        changes = (
            ("enable",),
            ("disable",),
            ("set", "--cpu-weight", "50"),
            ("set", "--hot-reload", "on"),
        )
        for verb, *more in changes:
            refused = cell.doractl(verb, cell.name, *more, check=False)
            said = f"cannot {verb} {cell.name}: release {release} is on trial"
            assert (refused.returncode, said in refused.stderr) == (1, True), refused.stderr
        assert not (ETC / cell.unit).exists()
        child.send_signal(signal.SIGTERM)
        assert child.wait() == 11
    assert not releases.trial.exists()


def test_a_disabled_release_is_not_taken_for_the_start_before_it(
    releases: Releases, project: Project
) -> None:
    flow, cell = write_version(project, "started"), releases.cell
    cell.start(flow)
    cell.doractl("stop", cell.name)
    write_version(project, "deployed")
    releases.deploy(project.root, *FAST)
    release = releases.current()
    cell.doractl("stop", cell.name)
    cell.doractl("disable", cell.name)
    for verb in ("start", "restart"):
        refused = cell.doractl(verb, cell.name, check=False)
        assert f"its release {release} is disabled" in refused.stderr
        assert f"doractl rollback {cell.name} {release}" in refused.stderr
        assert (refused.returncode, releases.running()) == (4, "")
    cell.doractl("rollback", cell.name, release)
    assert (releases.current(), releases.running()) == (release, release)
    cell.doractl("stop", cell.name)
    cell.doractl("disable", cell.name)
    cell.start(flow)
    cell.doractl("stop", cell.name)
    wait_for("systemd has forgotten it", lambda: cell.show("LoadState") == "not-found")
    cell.doractl("start", cell.name)
    assert releases.running() == ""


def test_a_first_trial_that_was_killed_can_be_ended(releases: Releases, project: Project) -> None:
    cell = releases.cell
    write_version(project, "first")
    with begin(releases, project, "1h") as child:
        wait_for("it runs", lambda: "version first" in cell.messages("a"))
        # Its child first, which would end the trial.
        for pid in run("pgrep", "--parent", str(child.pid)).stdout.split():
            with suppress(ProcessLookupError):  # others have ended by themselves
                os.kill(int(pid), signal.SIGKILL)
        child.kill()
    assert "trial" in releases.states().values()
    assert "on trial" in cell.doractl("doctor", check=False).stdout
    assert "its trial has ended" in cell.doractl("rollback", cell.name).stdout
    assert (releases.running(), list(releases.states().values())) == ("", ["unproved"])
    assert not releases.trial.exists()
    assert not (ETC / cell.unit).exists()
    again = cell.doractl("rollback", cell.name, check=False)
    assert (again.returncode, "no release before" in again.stderr) == (4, True)

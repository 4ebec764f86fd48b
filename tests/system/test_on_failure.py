"""The setting on_failure, with real systemd, journald and dora: who sends what, and how often."""

import json
import os
import pwd
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Timer

import pytest

from dora_systemd.decisions.notice.unit import MOST_LINES
from dora_systemd.errors import ExitCode
from dora_systemd.names import notice_command_unit, notice_unit
from tests.system.cells import Cell, Project, journalctl, run, wait_for
from tests.system.releases import Releases, write_version
from tests.system.test_bundle import STORE

# The units of notices are installed below /usr/local.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("units_for_all")]

SOURCE = """
import os, sys
from dora import Node
for event in Node():
    if os.path.exists("crash"):
        print("$(touch /tmp/owned) `id` ; boom", flush=True)
        sys.exit(7)
"""
SINK = """
from dora import Node
for event in Node():
    pass
"""
FLOW = """
nodes:
  - id: source
    path: source.py
    inputs: {tick: dora/timer/millis/20}
    restart_policy: never
  - {id: sink, path: sink.py, inputs: {tick: dora/timer/secs/1}}
"""
TELL = """#!/bin/sh
exec >"$OUT/$$.new"
env | grep ^DORA_NOTICE_ | sort
echo "user=$(id -un)"
echo "json=$(cat "$DORA_NOTICE_EVIDENCE")"
cat
mv "$OUT/$$.new" "$OUT/$$.notice"
"""
FAILS = ("after failure", "node exited with error", "source", "failed: ", "Failed with")


def flow(project: Project, tell: str = TELL) -> Path:
    project.write("source.py", SOURCE)
    project.write("sink.py", SINK)
    project.write("tell.sh", tell).chmod(0o755)
    (project.root / "out").mkdir()
    (project.root / "out").chmod(0o777)
    return project.write("flow.yml", FLOW)


def options(project: Project) -> list[str]:
    root = project.root
    return [f"--on-failure={root}/tell.sh", f"--writable={root}/out", f"--env=OUT={root}/out"]


def notices(project: Project) -> list[str]:
    files = sorted((project.root / "out").glob("*.notice"), key=lambda one: one.stat().st_mtime_ns)
    return [one.read_text() for one in files]


def lines(text: str) -> dict[str, str]:
    """The variables of a notice without their prefix."""
    pairs = (one.partition("=") for one in text.splitlines())
    return {key.removeprefix("DORA_NOTICE_"): value for key, _, value in pairs}


def recorded(cell: Cell, event: str) -> list[str]:
    matches = (f"DORA_EVENT={event}", f"DORA_DATAFLOW_NAME={cell.name}")
    return journalctl("-o", "cat", *matches).splitlines()


def ends(cell: Cell) -> None:
    """Wait until the service that sends notices has ended."""
    unit = notice_unit(cell.name)
    wait_for(
        "its end", lambda: "inactive" in run("systemctl", "is-active", unit, check=False).stdout
    )


@pytest.mark.warns(*FAILS)
def test_a_dataflow_fails(cell: Cell, project: Project) -> None:
    """The command gets why as its standard input, as the user of the nodes, once."""
    cell.start(flow(project), "--node=source:essential=yes", *options(project))
    project.write("crash", "")
    (text,) = wait_for("the notice", lambda: notices(project))
    found = lines(text)
    assert found["EVENT"] == "failed"
    assert (found["DATAFLOW"], found["UNIT"]) == (cell.name, cell.unit)
    assert (found["NODE"], found["COUNT"]) == ("source", "1")
    assert found["CAUSE"] == "essential node source: exit code 7"
    assert found["user"] == cell.show("User")
    assert json.loads(found["json"])["cause"] == "node-failed"
    assert f"\n{cell.name}: Failed\n" in text
    assert "$(touch /tmp/owned) `id` ; boom" in text
    assert not Path("/tmp/owned").exists()
    ends(cell)
    assert len(recorded(cell, "notice-sent")) == len(notices(project)) == 1


@pytest.mark.warns(*FAILS)
def test_a_node_is_given_up(cell: Cell, project: Project) -> None:
    """The dataflow runs without it; the runner itself may start nothing."""
    cell.start(flow(project), *options(project))
    project.write("crash", "")
    (text,) = wait_for("the notice", lambda: notices(project))
    found = lines(text)
    assert (found["EVENT"], found["NODE"]) == ("node-given-up", "source")
    assert f"\n{cell.name}: Degraded\n" in text
    assert "node-given-up" in [name for name, _ in cell.events()]
    ends(cell)
    cell.doractl("stop", cell.name)
    ends(cell)
    assert len(notices(project)) == 1


@pytest.mark.warns(*FAILS, "killed", "SIGKILL")
def test_a_killed_runner(cell: Cell, project: Project) -> None:
    cell.start(flow(project), *options(project))
    os.kill(int(cell.show("MainPID")), signal.SIGKILL)
    (text,) = wait_for("the notice", lambda: notices(project))
    assert lines(text)["CAUSE"] == "the supervisor process was killed (SIGKILL)"


@pytest.mark.warns("killed", "SIGKILL", "Failed with", "failed: ")
def test_a_kill_that_was_requested(cell: Cell, project: Project) -> None:
    """systemd calls the unit failed, and starts what sends notices and writes bundles."""
    cell.start(flow(project), "--black-box", "keep=3,size=10M", *options(project))
    cell.doractl("stop", "--now", cell.name)
    ended = f"{notice_unit(cell.name)}: Deactivated successfully"
    wait_for("its end", lambda: ended in journalctl("-u", notice_unit(cell.name)))
    assert (
        notices(project) == recorded(cell, "notice-sent") == recorded(cell, "bundle-written") == []
    )


@pytest.fixture
def late(project: Project) -> Iterator[Path]:
    """The service that sends notices waits for this file before it reads anything."""
    go = project.root / "go"
    place = Path("/run/systemd/system/doranotice@.service.d/waits.conf")
    place.parent.mkdir()
    wait = f"until [ -e {go} ]; do sleep 0.05; done"
    place.write_text(f"[Service]\nExecStartPre=/bin/sh -c '{wait}'\n")
    run("systemctl", "daemon-reload")
    yield go
    shutil.rmtree(place.parent)
    run("systemctl", "daemon-reload")


@pytest.mark.warns(*FAILS, "killed", "SIGKILL")
@pytest.mark.parametrize("by", ["doractl", "systemctl"])
def test_a_dataflow_that_is_stopped_before_its_notice(
    cell: Cell, project: Project, late: Path, by: str
) -> None:
    """What the notice needs is that of the failure, however late the service is that reads it."""
    policy = ["--restart-policy=on-failure", "--restart-delay=60s", "--max-restart-delay=60s"]
    cell.start(flow(project), *policy, *options(project), "--black-box=yes")
    user = cell.show("User")
    os.kill(int(cell.show("MainPID")), signal.SIGKILL)
    state = ("systemctl", "is-active", notice_unit(cell.name))
    wait_for("the service", lambda: "activating" in run(*state, check=False).stdout)
    wait_for("its end", lambda: cell.show("SubState") == "auto-restart")
    run(by, "stop", cell.name if by == "doractl" else cell.unit)
    assert (cell.show("ActiveState"), cell.show("LoadState")) == ("inactive", "loaded")
    assert notices(project) == []
    late.touch()
    (text,) = wait_for("the notice", lambda: notices(project))
    found = lines(text)
    assert (found["EVENT"], found["user"]) == ("failed", user)
    assert recorded(cell, "bundle-written")
    wait_for("systemd unloads it", lambda: cell.show("LoadState") == "not-found")
    ends(cell)
    assert recorded(cell, "notice-failed") == []
    shutil.rmtree(STORE / cell.name)


@pytest.mark.warns(*FAILS)
def test_a_start_waits_for_a_late_notice(cell: Cell, project: Project, late: Path) -> None:
    """systemd keeps the unit of a dataflow until the service has read its setting."""
    file = flow(project)
    cell.start(file, *options(project))
    crash = project.write("crash", "")
    state = ("systemctl", "is-active", notice_unit(cell.name))
    wait_for("the service", lambda: "activating" in run(*state, check=False).stdout)
    cell.doractl("stop", cell.name)
    assert cell.show("LoadState") == "loaded"
    crash.unlink()
    Timer(3, late.touch).start()
    cell.start(file, "--env=A=b", *options(project))
    assert late.exists()
    wait_for("the notice", lambda: notices(project))
    ends(cell)


@pytest.mark.warns(*FAILS)
def test_a_storm_is_few_notices(cell: Cell, project: Project) -> None:
    """It fails as fast as it can for a while: one notice at once, then one that has the number."""
    policy = ["--restart-policy=on-failure", "--max-restarts=infinity"]
    policy += ["--restart-delay=500ms", "--max-restart-delay=500ms"]
    path = flow(project)
    cell.start(path, "--node=source:essential=yes", *policy, *options(project))
    began = time.monotonic()
    project.write("crash", "")
    wait_for("two notices", lambda: len(notices(project)) == 2, 60)
    assert time.monotonic() - began >= 15
    run("systemctl", "stop", cell.unit)
    first, second = map(lines, notices(project))
    assert int(second["COUNT"]) > int(first["COUNT"])
    assert f"{second['COUNT']} failures within" in second["SUMMARY"]
    total = journalctl("-o", "cat", f"UNIT={cell.unit}").count("Failed with result")
    assert int(first["COUNT"]) + int(second["COUNT"]) <= total


@pytest.mark.warns(*FAILS, "not sent", "hangs")
@pytest.mark.parametrize("how", ["fails", "hangs", "floods"])
def test_a_command_that(cell: Cell, project: Project, how: str) -> None:
    """It is bounded and recorded, and its failure is no failure that is reported."""
    text = {
        "fails": "exit 3",
        "hangs": "trap '' TERM; sleep 1000 & sleep 1000",
        "floods": "yes boom | head -c 3000000; exit 3",
    }[how]
    reason = {
        "fails": "exit status 3",
        "hangs": "it has not ended within 30 s",
        "floods": "exit status 3",
    }[how]
    cell.start(flow(project, f"#!/bin/sh\n{text}\n"), *options(project))
    project.write("crash", "")
    wait_for("its record", lambda: recorded(cell, "notice-failed"), 60)
    ends(cell)
    (record,) = recorded(cell, "notice-failed")
    assert reason in record
    unit = notice_command_unit(cell.name)
    own = ("-o", "cat", f"_SYSTEMD_UNIT={unit}", "_TRANSPORT=stdout")
    # Of 600,000 lines. journald multiplies the limit by the free space, by 3.25 with 600 MB. When
    # systemd has unloaded the unit, its limit is gone: the lines that journald reads then, a few
    # hundred, are all kept.
    assert len(journalctl(*own).splitlines()) <= 20 * MOST_LINES
    assert "loaded" not in run("systemctl", "list-units", "--all", unit).stdout.splitlines()[0]
    assert cell.show("ActiveState") == "active"


@pytest.mark.warns(*FAILS, "not sent")
def test_a_unit_of_root(cell: Cell, project: Project) -> None:
    """The unit finds variables and reports as files, as long as it starts."""
    place = Path("/run/systemd/system/tell@.service")
    place.write_text(
        "[Service]\nType=oneshot\nEnvironmentFile=/run/doranotice/%i/environment\n"
        "StandardInput=file:/run/doranotice/%i/why.txt\n"
        "ExecStart=/bin/sh -c 'echo \"got $DORA_NOTICE_NODE\"; head -n 3'\n"
    )
    run("systemctl", "daemon-reload")
    try:
        cell.start(flow(project), "--on-failure=unit:tell@.service")
        project.write("crash", "")
        wait_for("its record", lambda: recorded(cell, "notice-sent"))
        text = journalctl("-o", "cat", f"_SYSTEMD_UNIT=tell@{cell.name}.service")
        assert text.startswith("got source\n")
        assert f"\n{cell.name}: Degraded\n" in text
    finally:
        place.unlink()
        run("systemctl", "daemon-reload")


@pytest.mark.warns(*FAILS)
def test_bad_commands_are_refused(cell: Cell, project: Project) -> None:
    """One line each before anything starts; a user's file names no unit."""
    path = flow(project)
    for words in ("no-such-program", "./no/such", "unit:no-such.service", "unit:dora-x.service"):
        done = cell.start(path, f"--on-failure={words}", check=False)
        assert done.returncode in (ExitCode.BAD_INPUT, ExitCode.USAGE), done.stderr
        assert len(done.stderr.splitlines()) == 2, done.stderr
    assert cell.show("LoadState") == "not-found"


@pytest.mark.warns(*FAILS)
def test_requests_of_a_hostile_runner(cell: Cell, project: Project) -> None:
    """Links in its directory lead root nowhere, and a tree there does not start it for ever."""
    cell.start(flow(project), *options(project))
    directory = Path("/run/dora-systemd-notice") / cell.name
    user = cell.show("User")
    assert directory.owner() == user
    assert directory.parent.owner() == "root"
    victim = project.write("victim", "")
    run("runuser", "-u", user, "--", "ln", "-s", str(victim), str(directory / "request"))
    wait_for("it is removed", lambda: not list(directory.iterdir()))
    ends(cell)
    run("runuser", "-u", user, "--", "mkdir", "-p", str(directory / "a/b"))
    path = notice_unit(cell.name, ".path")
    wait_for("its stop", lambda: run("systemctl", "is-active", path, check=False).returncode)
    ends(cell)
    assert victim.exists()
    assert notices(project) == recorded(cell, "notice-sent") == []


@pytest.mark.warns(*FAILS, "rolled back", "crashed", "exit code", "Failed to start")
def test_a_release_is_rolled_back(releases: Releases, project: Project) -> None:
    """The notice reports that, and not the failure that it was the answer to."""
    flow(project)
    write_version(project, "1")
    releases.deploy(project.root, "--soak", "0s", *options(project))
    good = releases.current()
    write_version(project, "bad", "raise SystemExit(3)\n")
    releases.deploy(project.root, "--soak", "0s", *options(project), status=11)
    assert releases.running() == good
    wait_for(
        "the notice", lambda: "rolled-back" in [lines(one)["EVENT"] for one in notices(project)]
    )
    ends(releases.cell)
    found = lines(notices(project)[-1])
    assert "exit code 3" in found["CAUSE"]


@pytest.mark.warns(*FAILS)
def test_in_user_scope(project: Project) -> None:
    """The user's manager starts it; nobody else has to do anything."""
    path, root = flow(project), project.root
    user = pwd.getpwuid(1000)
    run("chown", "--recursive", user.pw_name, str(root))
    own = ["setpriv", "--reuid=1000", "--regid=1000", "--init-groups", "env"]
    own += ["XDG_RUNTIME_DIR=/run/user/1000", f"HOME={user.pw_dir}", "doractl", "--user"]
    words = [f"--on-failure={root}/tell.sh", f"--env=OUT={root}/out"]
    run(*own, "start", str(path), "--name", "mine", *words)
    try:
        project.write("crash", "")
        (text,) = wait_for("the notice", lambda: notices(project))
        found = lines(text)
        assert (found["EVENT"], found["user"]) == ("node-given-up", user.pw_name)
        assert found["EVIDENCE"] == "/run/user/1000/doranotice/mine/why.json"
        assert json.loads(found["json"])["node"] == "source"
    finally:
        run(*own, "stop", "mine")

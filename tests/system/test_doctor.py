"""doractl doctor on a machine with dataflows, with leftovers, and without systemd."""

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, is_alive, run, wait_for

# Looks at the processes of everybody, and makes some.
pytestmark = pytest.mark.lab


def findings(*caller: str) -> list[dict[str, Any]]:
    """What it finds; the exit status says whether one is a problem."""
    done = run(*caller, "doractl", "doctor", "-o", "json", check=False)
    found: list[dict[str, Any]] = json.loads(done.stdout)
    assert done.stderr == ""
    assert done.returncode == any(one["state"] == "problem" for one in found)
    assert all(one["remedy"] for one in found if one["state"] in ("warning", "problem"))
    return found


def of(topic: str, found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one for one in found if one["topic"] == topic]


def test_a_machine_with_a_dataflow(cell: Cell, project: Project) -> None:
    """What runs in a cell is nothing to find."""
    cell.start(project.three_nodes())
    found = findings()
    assert {
        one["state"] for topic in ("systemd", "dora", "journal") for one in of(topic, found)
    } == {"ok"}
    for topic in ("bare dora", "left over", "port 6013"):
        assert [one["state"] for one in of(topic, found)] == ["ok"], topic
    lines = run("doractl", "doctor").stdout.splitlines()
    assert any(line.startswith("ok       systemd") for line in lines)


def test_a_user() -> None:
    user = ("runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000")
    found = findings(*user)
    assert of("systemd", found)[0]["state"] == "ok"
    assert of("linger", found)[0]["state"] == "ok"


def test_a_journal_that_keeps_nothing() -> None:
    """The files of before are still there; root and a user are told the same."""
    user = ("runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000")
    drop_in = Path("/etc/systemd/journald.conf.d/50-storage.conf")
    drop_in.parent.mkdir(exist_ok=True)

    def told(storage: str) -> str:
        drop_in.write_text(f"[Journal]\nStorage={storage}\n")
        run("systemctl", "restart", "systemd-journald")
        run("journalctl", "--flush")
        # Before this, a user may be told that the records cannot be read.
        one, other = (of("journal", findings(*caller))[-1] for caller in ((), user))
        assert one == other
        return f"{one['state']}: {one['text']}"

    try:
        assert told("none") == "warning: no line is kept: journald has Storage=none"
        assert told("volatile") == "warning: it is kept in memory and lost at a reboot"
        assert told("persistent") == "ok: it survives a reboot"
    finally:
        drop_in.unlink()
        run("systemctl", "restart", "systemd-journald")
        run("journalctl", "--flush")


def test_without_systemd() -> None:
    """The rest is still looked at."""
    hidden = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs none /run && exec "$@"', "sh")
    found = findings(*hidden)
    (systemd,) = of("systemd", found)
    assert systemd["state"] == "problem"
    assert str(systemd["remedy"]).startswith("this machine was not booted with systemd: ")
    assert of("dora", found)[0]["state"] == "ok"


def test_bare_dora(tmp_path: Path) -> None:
    command = ["dora", "coordinator", "--store", "memory"]
    coordinator = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL)
    try:
        taken = wait_for(
            "its port",
            lambda: [one for one in of("port 6013", findings()) if one["state"] == "note"],
        )
        assert f"process {coordinator.pid} " in taken[0]["text"]
        (bare,) = of("bare dora", findings())
        assert f"kill {coordinator.pid}" in bare["remedy"]
    finally:
        coordinator.kill()
        coordinator.wait()


def test_orphans() -> None:
    """A node whose daemon was killed, as bare dora leaves it."""
    script = "sleep 300 >/dev/null 2>&1 & echo $!"
    environment = {**os.environ, "DORA_NODE_CONFIG": "x"}
    # It belongs to no session of ours, as after the end of its daemon.
    pid = int(run("sh", "-c", script, env=environment).stdout)
    try:
        found = of("orphan", findings())
        assert [one["remedy"] for one in found] == [f"kill {pid}"]
    finally:
        os.kill(pid, signal.SIGKILL)
        wait_for("its end", lambda: not is_alive(pid))


def test_leftovers() -> None:
    directory = Path("/run/dora-systemd/ghost")
    directory.mkdir(parents=True)
    try:
        (left,) = of("left over", findings())
    finally:
        directory.rmdir()
    assert left["remedy"] == f"rm -r {directory}"


@pytest.mark.warns("dora-broken.service")
def test_a_broken_unit(cell: Cell, project: Project) -> None:
    """It hinders nobody else."""
    etc = Path("/etc/systemd/system")
    path = etc / "dora-broken.service"
    link = etc / "multi-user.target.wants" / path.name
    path.write_text("[Service]\nnonsense\n")
    link.symlink_to(path)
    run("systemctl", "daemon-reload")
    try:
        cell.start(project.three_nodes())
        assert [row["name"] for row in json.loads(run("doractl", "list", "-o", "json").stdout)] == [
            cell.name
        ]
        assert "dora-broken.service cannot be loaded" in of("units", findings())[0]["text"]
        assert of("boot", findings())[-1]["state"] == "warning"
        refused = run(
            "doractl", "start", str(project.root / "dataflow.yml"), "--name", "broken", check=False
        )
        assert refused.returncode == ExitCode.NAME_IN_USE
    finally:
        path.unlink()
        link.unlink()
        run("systemctl", "daemon-reload")


def test_a_half_written_settings_file() -> None:
    path = Path("/etc/dora-systemd/config.yml")
    path.parent.mkdir(exist_ok=True)
    path.write_text("memory_limit: [4G\n")
    try:
        assert of("settings", findings())[0]["state"] == "problem"
        assert run("doractl", "doctor", check=False).returncode == ExitCode.FAILURE
    finally:
        path.unlink()


def test_in_the_environment_of_somebody_else() -> None:
    """As by su without a dash: $HOME is a directory that the caller may not read."""
    words = ("--reuid=1000", "--regid=1000", "--clear-groups", "env", "HOME=/root")
    done = run("setpriv", *words, "doractl", "--system", "doctor", check=False)
    assert "systemd" in done.stdout
    assert done.stderr == ""

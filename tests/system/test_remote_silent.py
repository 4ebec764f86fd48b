"""deploy -H and a host that says nothing any more, although ssh is content."""

import os
import signal
import subprocess
import sys

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Project, run, wait_for
from tests.system.releases import Releases, write_version
from tests.system.test_remote_deploy import FAST, arm, base, deploy, rows, servers, versions

__all__ = ["arm", "base", "servers"]
pytestmark = pytest.mark.lab

_IMPATIENT = """
import sys
from dora_systemd.cli.remote import rollout
rollout.SILENCE_SECONDS = float(sys.argv.pop(1))
from dora_systemd.cli.main import main
main()
"""
"""A doractl that waits for signs of life for less than ten minutes."""


@pytest.mark.usefixtures("arm")
def test_a_host_that_hangs(base: Releases, project: Project) -> None:
    """It is given up, and its trial is undone when it wakes up; the others are not tried."""
    name = base.cell.name
    write_version(project, "good")
    assert deploy(project, name, *FAST, "-H", "base").returncode == 0
    good = base.current()
    write_version(project, "next")
    words = ("deploy", str(project.root), "--name", name, "--soak", "1h", "-H", "base,arm")
    command = [sys.executable, "-c", _IMPATIENT, str(bound(10)), *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        wait_for("it runs", lambda: "version next" in base.cell.messages("a"))
        (pid,) = run("pgrep", "-f", "doractl deploy .*--from-stdin", "--oldest").stdout.split()
        os.kill(int(pid), signal.SIGSTOP)
        try:
            out, err = child.communicate(timeout=bound(60))
        finally:
            os.kill(int(pid), signal.SIGCONT)
    assert [row[:2] for row in rows(out)] == [["base", "lost"], ["arm", "not"]]
    assert "the connection to base is lost: no word for" in err
    assert child.returncode == ExitCode.NO_HOST
    wait_for("it is back", lambda: not base.trial.exists() and base.running() == good)
    assert (base.current(), versions(base.cell, "arm")) == (good, {})

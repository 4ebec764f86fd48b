"""doractl -H from one machine to others, with cables that are pulled and power that is cut."""

import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.machines.flows import PLACE
from tests.machines.wires import OTHERS, bring, cable, clear, power_cut, there
from tests.system.cells import Project, run, wait_for


@pytest.fixture(scope="module", autouse=True)
def files() -> None:
    """A dataflow of one machine."""
    shutil.rmtree(PLACE, ignore_errors=True)
    project = Project(Path(PLACE))
    project.three_nodes()
    for name in OTHERS:
        bring(name, project.root)


@pytest.fixture(autouse=True)
def dataflows(files: None) -> Iterator[None]:
    """The same dataflow on both of the others, enabled on b."""
    del files
    started = doractl("start", f"{PLACE}/dataflow.yml", "--name", "robot", "-H", "b,c")
    assert started.returncode == 0, started.stderr
    assert doractl("enable", "robot", "-H", "b").returncode == 0
    yield
    doractl("disable", "robot", "-H", "b")
    for name in OTHERS:
        clear(name)


def doractl(*words: str) -> subprocess.CompletedProcess[str]:
    return run("doractl", *words, check=False)


def running() -> dict[str, str]:
    """The status of the dataflow by host."""
    done = doractl("list", "-H", "b,c", "-o", "json")
    return {one["host"]: one["status"] for one in json.loads(done.stdout)}


def test_all_see_all() -> None:
    assert running() == {"b": "Running", "c": "Running"}
    assert doractl("list").stdout.count("robot") == 0
    assert doractl("restart", "robot", "-H", "b,c").returncode == 0
    why = doractl("why", "robot", "-H", "b,c").stdout
    assert re.findall("==> (.*) <==", why) == ["b", "c"]


@pytest.mark.parametrize("how", ["off", "mute"])
def test_a_dead_host_takes_bounded_time(how: str) -> None:
    with cable("b", how):
        begun = time.monotonic()
        done = doractl("list", "-H", "b,c")
        assert time.monotonic() - begun < bound(15)
        rows = [line.split()[:4] for line in done.stdout.splitlines()[1:]]
        assert [(row[0], row[3]) for row in rows] == [("c", "Running"), ("b", "Unreachable")]
        assert done.stderr.startswith("doractl: cannot reach b: ")
        assert done.returncode == ExitCode.NO_HOST
        assert doractl("stop", "robot", "-H", "b,c").returncode == ExitCode.NO_HOST
    assert running() == {"b": "Running", "c": "Stopped"} or running() == {"b": "Running"}


@pytest.mark.parametrize("how", ["off", "mute"])
def test_a_cable_pulled_in_the_middle_of_the_logs(how: str) -> None:
    """What the other host says goes on, and what is lost is named."""
    command = ["doractl", "logs", "robot", "-f", "-H", "b,c"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as child:
        assert child.stdout
        assert child.stderr
        # A thread reads all lines: with a full pipe doractl blocks, and cannot report the loss.
        lines = SimpleQueue[str]()
        reader = Thread(target=lambda out: [*map(lines.put, out)], args=(child.stdout,))
        reader.start()
        seen = set[str]()
        while seen != set(OTHERS):
            seen.add(lines.get().split()[0])
        with cable("b", how):
            assert child.stderr.readline().startswith("doractl: ")
            while not lines.empty():
                lines.get()
            while not lines.get().startswith("c"):
                pass
        child.terminate()
        reader.join()
    wait_for("nobody follows on c", lambda: there("c", "pgrep", "-f", "doractl logs").returncode)


def test_power_comes_back() -> None:
    """What is enabled runs again, what is not does not."""
    with power_cut("b"):
        assert doractl("list", "-H", "b").returncode == ExitCode.NO_HOST
    wait_for("it runs again", lambda: running().get("b") == "Running")
    life = json.loads(doractl("show", "robot", "-H", "b", "-o", "json").stdout)
    assert life["name"] == "robot"
    with power_cut("c"):
        pass
    assert "c" not in running()

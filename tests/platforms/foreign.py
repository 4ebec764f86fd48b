"""Debian for arm64, whose programs are emulated: the packages by apt, the wheels by pip.

It takes minutes, so `make test` has none of it. There is no sandbox, see tests/lab/foreign.py.
"""

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.deb.packages import install
from tests.system.cells import Project, run, wait_for

CHECKOUT = Path(__file__).parents[2]
PLAIN = ("env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LANG=C.UTF-8", "HOME=/root")
OPTIONS = ("--name", "robot", "--venv", "/opt/lab", "--sandbox", "none", "--network", "host")


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    install()


@pytest.fixture
def flow() -> Iterator[Path]:
    project = Project(Path("/srv/robot"))
    yield project.three_nodes()
    shutil.rmtree(project.root)


def doractl(*words: str) -> str:
    return run(*PLAIN, "doractl", *words).stdout


def test_what_runs_here_is_of_arm64() -> None:
    assert os.uname().machine == "aarch64"
    assert run("dpkg", "--print-architecture").stdout == "arm64\n"
    assert doractl("--version").startswith("doractl ")
    assert json.loads(doractl("version", "-o", "json"))["dora"] == "1.1.0"


def test_a_life(flow: Path) -> None:
    unit = doractl("start", str(flow), "--dry-run", *OPTIONS)
    assert "ExecStart=:/usr/bin/python3 -E -P -m dora_systemd.runner --name=robot" in unit
    assert doractl("start", str(flow), *OPTIONS).startswith("Dataflow started: ")
    (row,) = json.loads(doractl("list", "-o", "json"))
    assert (row["name"], row["status"], row["nodes_alive"]) == ("robot", "Running", 3)
    logs = ("logs", "robot", "--node", "sink", "-o", "cat")
    wait_for("the sink prints", lambda: "got" in doractl(*logs))
    assert "3/3 nodes running" in doractl("why", "robot")
    assert "Dataflow stopped: " in doractl("stop", "robot")


def test_the_wheels(tmp_path: Path) -> None:
    """Those that `make arm64` has built; /opt/wheels has what PyPI has."""
    venv = tmp_path / "venv"
    run("python3", "-m", "venv", str(venv))
    places = ("--find-links=/opt/wheels", f"--find-links={CHECKOUT / 'dist/wheels-arm64'}")
    only = ("--no-index", "--only-binary=:all:")
    run(f"{venv}/bin/pip", "install", *only, *places, "dora-systemd", "dora-rs-cli")
    shown = run(*PLAIN, f"{venv}/bin/doractl", "version", "-o", "json").stdout
    assert re.fullmatch(r"257\..*", json.loads(shown)["systemd"])
    assert json.loads(shown)["dora"] == "1.1.0"

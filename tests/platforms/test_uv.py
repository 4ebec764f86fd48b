"""What an ordinary user has without root and without a compiler: wheels, installed by uv."""

import json
import pwd
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.platforms import test_packages
from tests.system.cells import Project, run, wait_for, wait_no_process

CHECKOUT = Path(__file__).parents[2]
USER = "bob"
HOME = Path(pwd.getpwnam(USER).pw_dir)
OFFLINE = "uv tool install --offline --no-index --find-links /opt/wheels"
"""There is no network here; /opt/wheels has what PyPI has."""


def as_user(line: str, check: bool = True) -> CompletedProcess[str]:
    """Run a line in a shell of USER, which finds uv and what uv has installed."""
    path = f"{HOME}/.local/bin:/opt/lab/bin:/usr/bin:/bin"
    shell = ("sh", "-c", f"PATH={path}; cd {CHECKOUT}; {line}")
    return test_packages.as_user(USER, *shell, check=check)


@pytest.fixture(scope="module")
def installed() -> Iterator[None]:
    """By the line of docs/install.md, on a machine without the packages."""
    run("dpkg", "--purge", "dora-systemd", "dora-cli")
    page = (CHECKOUT / "docs/install.md").read_text()
    (line,) = re.findall(r"^uv tool install .*$", page, re.MULTILINE)
    as_user(f"{line.replace('uv tool install', OFFLINE)} --python /usr/bin/python3")
    yield
    as_user("doractl setup --remove && uv tool uninstall dora-systemd")


@pytest.fixture
def flow() -> Iterator[Path]:
    project = Project(HOME / "robot")
    shutil.chown(project.root, USER, USER)
    yield project.three_nodes()
    as_user("doractl disable robot; doractl stop robot", check=False)
    shutil.rmtree(project.root)
    wait_no_process()


@pytest.mark.usefixtures("installed")
def test_five_minutes_of_an_ordinary_user(flow: Path) -> None:
    assert "Installed: " in as_user("doractl setup").stdout
    said = as_user(f"doractl start {flow} --venv /opt/lab")
    assert said.stdout.startswith("Dataflow started: ")
    (row,) = json.loads(as_user("doractl list -o json").stdout)
    assert (row["name"], row["status"], row["nodes_alive"]) == ("robot", "Running", 3)
    logs = "doractl logs robot --node sink -o cat --no-pager"
    wait_for("the sink prints", lambda: "got" in as_user(logs).stdout)
    assert "3/3 nodes running" in as_user("doractl why robot").stdout
    assert "Dataflow restarted: " in as_user("doractl restart robot").stdout
    assert "Dataflow enabled: " in as_user("doractl enable robot").stdout
    assert "Dataflow stopped: " in as_user("doractl stop robot").stdout

"""What an ordinary user has without root and without a compiler: wheels, by uv or pipx."""

import json
import pwd
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.deb.packages import caller, make_venv
from tests.platforms import test_packages
from tests.system.cells import Project, run, wait_for, wait_no_process
from tests.system.typed import Shell, as_text, type_line, typed_lines

CHECKOUT = Path(__file__).parents[2]
PAGE = CHECKOUT / "docs/install.md"
USER = "bob"
UID = pwd.getpwnam(USER).pw_uid
HOME = Path(pwd.getpwnam(USER).pw_dir)
PROJECT = HOME / "robot"
ENVIRONMENT = (
    f"PATH={HOME}/.local/bin:/opt/lab/bin:/usr/bin:/bin",
    "UV_OFFLINE=1",
    "UV_NO_INDEX=1",
    "UV_PYTHON=/usr/bin/python3",
    f"UV_FIND_LINKS={CHECKOUT}/dist/wheels",
    "PIP_NO_INDEX=1",
    f"PIP_FIND_LINKS={CHECKOUT}/dist/wheels",
    f"PIPX_HOME={HOME}/pipx",
)
"""Of USER, who finds uv and what it has installed. There is no network here."""


def as_user(line: str, check: bool = True) -> CompletedProcess[str]:
    """Run a line in a shell of USER."""
    shell = ("env", *ENVIRONMENT, "sh", "-c", f"cd {CHECKOUT}; {line}")
    return test_packages.as_user(USER, *shell, check=check)


def lines_of(program: str) -> list[str]:
    """What docs/install.md says to type of that program."""
    return re.findall(rf"^(?:\$ )?({program} .*)$", PAGE.read_text(), re.MULTILINE)


def offer_wheels() -> None:
    """Put what PyPI has beside those that `make wheels` has built."""
    for wheel in Path("/opt/wheels").glob("*.whl"):
        shutil.copy(wheel, CHECKOUT / "dist/wheels")


def install_by_uv() -> None:
    offer_wheels()
    (line,) = lines_of("uv tool install")
    as_user(line)


@pytest.fixture
def bare() -> Iterator[None]:
    """A machine without the packages."""
    run("dpkg", "--purge", "dora-systemd", "dora-cli")
    offer_wheels()
    yield
    remove = "uv tool uninstall dora-systemd || pipx uninstall dora-systemd"
    as_user(f"doractl setup --remove; {remove}", check=False)


@pytest.fixture
def flow() -> Iterator[Path]:
    project = Project(PROJECT)
    shutil.chown(project.root, USER, USER)
    yield project.three_nodes()
    leave_nothing()


def leave_nothing() -> None:
    as_user("doractl disable robot; doractl stop robot", check=False)
    shutil.rmtree(PROJECT)
    wait_no_process()


@pytest.mark.usefixtures("bare")
def test_the_page_as_an_ordinary_user_types_it() -> None:
    """By uv."""
    words = (*caller(USER), "env", f"XDG_RUNTIME_DIR=/run/user/{UID}", *ENVIRONMENT)
    shell, wrong = Shell(words, CHECKOUT), []
    (block,) = re.findall(r"^```\n(\$ .*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    for typed in typed_lines(block):
        if "pip install" in typed.line:  # of the nodes: theirs is the same, from the image
            make_venv(PROJECT / ".venv")
            continue
        shown, status = type_line(shell, typed)
        print(as_text(typed.line, shown, status), end="")
        if not typed.fits(shown, status):
            wrong.append(as_text(typed.line, shown, status))
    shell.end()
    leave_nothing()
    assert not wrong, "\n".join(wrong)


@pytest.mark.usefixtures("bare")
def test_five_minutes_with_pipx(flow: Path) -> None:
    # pipx would load a newer pip for this environment, which is there already.
    as_user(f"/usr/bin/python3 -m venv {HOME}/pipx/shared")
    for line in lines_of("pipx"):
        as_user(line)
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

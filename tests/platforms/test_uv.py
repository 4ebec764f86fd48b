"""Without the packages and a compiler: wheels by uv or pipx for a user, and by pip for root."""

import json
import pwd
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.deb.packages import caller, make_venv
from tests.platforms import test_packages
from tests.platforms.table import HERE
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
DORACTL = "/opt/dora-systemd/bin/doractl"
"""The command that pip installs for root, as docs/install.md says."""


def as_user(line: str, check: bool = True) -> CompletedProcess[str]:
    """Run a line in a shell of USER."""
    shell = ("env", *ENVIRONMENT, "sh", "-c", f"cd {CHECKOUT}; {line}")
    return test_packages.as_user(USER, *shell, check=check)


def lines_of(program: str) -> list[str]:
    """What docs/install.md says to type of that program."""
    return re.findall(rf"^(?:\$ )?({program} .*)$", PAGE.read_text(), re.MULTILINE)


def block_below(words: str) -> list[str]:
    """The lines of the first block of docs/install.md below these words."""
    (block,) = re.findall(rf"^{words}\n+```\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return str(block).splitlines()


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


def as_root(line: str, check: bool = True) -> CompletedProcess[str]:
    """Run a line in a shell of root, in the checkout. pip finds what PyPI has, and setuptools."""
    places = f"PIP_FIND_LINKS={CHECKOUT}/dist/wheels /usr/share/python-wheels"
    shell = ("env", "PIP_NO_INDEX=1", places, "sh", "-c", f"cd {CHECKOUT}; {line}")
    return test_packages.as_user("root", *shell, check=check)


@pytest.fixture
def by_pip(bare: None) -> Iterator[Path]:
    """A machine without the packages, and a dataflow; afterwards without what pip has installed."""
    del bare
    root = Path(tempfile.mkdtemp(prefix="pip-", dir="/var/tmp"))
    root.chmod(0o755)
    yield Project(root / "project").three_nodes()
    as_root(f"{DORACTL} destroy --force; {DORACTL} setup --remove", check=False)
    shutil.rmtree(Path(DORACTL).parents[1])
    shutil.rmtree(root)


@pytest.mark.skipif(HERE.python == "3.11", reason="its setuptools needs wheel, which PyPI has")
def test_pip_as_root(by_pip: Path) -> None:
    """The page's lines; doractl is beside that Python, and so is dora."""
    for line in block_below("As root, with pip:"):
        said = as_root(line).stdout
    assert said.startswith("Installed: ")
    assert pwd.getpwnam("dora").pw_shell == "/usr/sbin/nologin"
    command = f"{DORACTL} start {by_pip} --name robot --venv /opt/lab --network host --enable"
    assert as_root(command).stdout.startswith("Dataflow started: ")
    assert "3/3 nodes running" in as_root(f"{DORACTL} why robot").stdout
    assert run("systemctl", "is-enabled", "dora-robot").stdout == "enabled\n"
    shown = json.loads(as_root(f"{DORACTL} version -o json").stdout)
    assert (shown["python"].startswith(HERE.python), shown["dora"]) == (True, "1.1.0")
    assert "Dataflow disabled: " in as_root(f"{DORACTL} disable robot").stdout
    assert "Dataflow stopped: " in as_root(f"{DORACTL} stop robot").stdout


@pytest.mark.skipif(HERE.python == "3.11", reason="its setuptools needs wheel, which PyPI has")
def test_pip_with_a_umask_that_closes_what_it_installs(by_pip: Path) -> None:
    """The user dora executes neither Python nor doractl there; doctor says so before a start."""
    del by_pip
    for line in block_below("As root, with pip:"):
        as_root(f"umask 077; {line}")
    place = Path(DORACTL).parents[1]

    def user() -> dict[str, str]:
        found = json.loads(as_root(f"{DORACTL} doctor -o json", check=False).stdout)
        return dict(next(one for one in found if one["topic"] == "user"))

    for closed in (place / "bin", place / "lib"):
        assert user()["state"] == "problem"
        assert f"cannot read {closed}/" in user()["text"]
        as_root(f"chmod a+rX {place}; chmod -R a+rX {closed}")
    assert user()["state"] == "ok"

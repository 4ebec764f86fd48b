"""Sixteen tasks as a person types them, from the first start to the end.

Each is a text: tests/system/typed.py says how it is read. Where one differs, the whole of it is
printed as it was really shown. Two of them need another lab: reboot.txt is replayed by tests/boot,
uninstall.txt by tests/deb.
"""

import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.deb.packages import ROBOT
from tests.system.cells import run, wait_no_process
from tests.system.releases import STORE
from tests.system.typed import Shell, replay

# They have the name of the README's robot, and a journal that knows of no other.
pytestmark = pytest.mark.lab

HERE = Path(__file__).parent
PLACE = Path("/srv/robot")
ELSEWHERE = ("reboot", "uninstall")
MODULES = Path("/opt/numpy")
"""What the nodes of the robot import and others do not, see tests/lab/definition.py."""
TASKS = [path for path in sorted(HERE.glob("*.txt")) if path.stem not in ELSEWHERE]


@pytest.fixture(scope="module")
def numpy() -> Iterator[None]:
    """As on a machine where numpy was installed with dora-rs."""
    places = Path("/opt/lab/lib").glob("python3*/site-packages") if MODULES.exists() else ()
    links = [place / one.name for place in places for one in MODULES.glob("numpy*")]
    for link in links:
        link.symlink_to(MODULES / link.name)
    yield
    for link in links:
        link.unlink()


@pytest.fixture
def shell(numpy: None) -> Iterator[Shell]:
    del numpy
    shutil.copytree(ROBOT, PLACE)
    run("chmod", "--recursive", "a+rX", str(PLACE))
    run("journalctl", "--quiet", "--rotate")
    run("journalctl", "--quiet", "--vacuum-time=1us")
    shell = Shell(("env",), PLACE)
    yield shell
    shell.end()
    run("doractl", "disable", "robot", check=False)
    run("doractl", "destroy", "--force")
    run("systemctl", "reset-failed", "dora-robot", check=False)
    run("umount", f"{PLACE}/records", check=False)
    shutil.rmtree(STORE / "robot", ignore_errors=True)
    (STORE / ".robot.lock").unlink(missing_ok=True)
    shutil.rmtree(PLACE)
    wait_no_process()


def needs(path: Path) -> list[pytest.MarkDecorator]:
    """The lab, and the module, that a task needs."""
    text, has_module = path.read_text(), find_spec("watchfiles") is not None
    without = pytest.mark.skipif(not has_module, reason="this lab has no watchfiles")
    return [
        *([pytest.mark.vm] if "Needs memory limits." in text else []),
        *([without] if "Needs watchfiles." in text else []),
    ]


@pytest.mark.parametrize(
    "path", [pytest.param(one, marks=needs(one), id=one.stem) for one in TASKS]
)
def test_task(path: Path, shell: Shell) -> None:
    wrong = replay(shell, path.read_text())
    assert not wrong, f"{path.name} differs:\n" + "".join(wrong)

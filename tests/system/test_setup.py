"""doractl setup on a machine without the package."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.place import SOCKET_UNIT
from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run
from tests.system.gateways import Front

# Writes below /usr/local and to /etc/fish.
pytestmark = pytest.mark.lab

LOCAL = Path("/usr/local")
PLACES = (LOCAL, Path("/etc/fish"))


def files() -> set[Path]:
    return {path for place in PLACES for path in place.rglob("*") if not path.is_dir()}


@pytest.fixture
def removed() -> Iterator[set[Path]]:
    """What is there before and after."""
    before = files()
    yield before
    run("doractl", "setup", "--remove", check=False)
    assert files() == before


def test_setup_and_remove(removed: set[Path]) -> None:
    first = run("doractl", "setup")
    assert first.stderr == ""
    new = files() - removed
    assert {Path(line.removeprefix("Installed: ")) for line in first.stdout.splitlines()} == new
    units = [str(path) for path in new if path.parent.parent.name == "systemd"]
    verify = ("systemd-analyze", "verify", "--man=no")
    assert run(*verify, *(one for one in units if "/system/" in one)).stderr == ""
    assert "dora.target" in run("systemctl", "list-dependencies", "multi-user.target").stdout
    assert "Dataflow @DORA_DATAFLOW_NAME@" in run("journalctl", "--dump-catalog").stdout
    assert run("id", "-un", "dora").stdout == "dora\n"
    assert LOCAL / "share/man/man1/doractl.1" in new
    assert run("doractl", "setup").stdout == "Everything is installed.\n"
    done = run("doractl", "setup", "--remove")
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == len(new)
    assert run("doractl", "setup", "--remove").stdout == "Nothing to remove.\n"


def test_a_user_that_is_gone_is_made_again(removed: set[Path]) -> None:
    run("doractl", "setup")
    run("userdel", "dora")
    assert run("doractl", "setup").stdout == "Everything is installed.\n"
    assert run("id", "-un", "dora").stdout == "dora\n"
    assert files() > removed


def test_not_while_it_is_needed(removed: set[Path], cell: Cell, project: Project) -> None:
    run("doractl", "setup")
    cell.start(project.three_nodes(), "--enable")
    assert cell.show("WantedBy") == "dora.target"
    there = files()
    done = run("doractl", "setup", "--remove", check=False)
    assert (done.returncode, done.stdout) == (ExitCode.FAILURE, "")
    assert cell.name in done.stderr
    assert files() == there
    assert there > removed
    cell.doractl("disable", cell.name)


def test_the_gateway_ends_with_its_units(removed: set[Path], front: Front) -> None:
    run("doractl", "setup")
    front.doractl("up")
    assert front.show("FragmentPath", SOCKET_UNIT).startswith("/usr/local/lib/systemd/")
    done = run("doractl", "setup", "--remove")
    assert done.stdout.startswith("Gateway stopped\n")
    assert front.show("ActiveState", SOCKET_UNIT) == "inactive"
    assert files() == removed


def test_users_have_their_own() -> None:
    user = ("runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000")
    refused = run(*user, "doractl", "--system", "setup", check=False)
    assert refused.returncode == ExitCode.NO_PERMISSION
    data = Path("/home/alice/.local/share")
    run(*user, "doractl", "setup")
    assert (data / "systemd/user/dora.target").exists()
    units = [str(path) for path in data.glob("systemd/user/dora.*")]
    assert run(*user, "systemd-analyze", "verify", "--man=no", "--user", *units).stderr == ""
    shown = run(*user, "systemctl", "--user", "show", "dora.target", "-p", "WantedBy").stdout
    assert shown == "WantedBy=default.target\n"
    run(*user, "doractl", "setup", "--remove")
    assert not [path for path in data.rglob("*") if path.is_file() and "dora" in path.name]

"""doractl enable --boot-check: a boot is good only if the dataflow comes up."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for

# They write to /etc.
pytestmark = pytest.mark.lab

TARGET = "boot-complete.target"
ETC = Path("/etc/systemd/system")


@pytest.fixture
def checked(cell: Cell) -> Iterator[Cell]:
    """A cell that is not enabled any more at the end."""
    yield cell
    run("systemctl", "stop", TARGET)
    cell.doractl("disable", cell.name, check=False)
    cell.end()
    run("systemctl", "reset-failed", TARGET, check=False)


def required() -> str:
    return run("systemctl", "list-dependencies", "--plain", TARGET).stdout


def test_a_good_boot(checked: Cell, project: Project) -> None:
    checked.start(project.three_nodes())
    checked.doractl("enable", checked.name)
    assert checked.unit not in required()
    done = checked.doractl("enable", checked.name, "--boot-check")
    assert f"Dataflow enabled: {checked.doractl('list', '-q').stdout.strip()}" in done.stdout
    assert "already" in checked.doractl("enable", checked.name, "--boot-check").stdout
    path = ETC / checked.unit
    verified = run("systemd-analyze", "verify", str(path), check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    assert (ETC / f"{TARGET}.requires" / checked.unit).is_symlink()
    checked.doractl("stop", checked.name)
    assert checked.unit in required()
    assert checked.unit in run("systemctl", "show", "--value", "-p", "After", TARGET).stdout
    run("systemctl", "start", TARGET)
    assert checked.show("ActiveState") == "active", "it was started, and all nodes are ready"
    checked.doractl("stop", checked.name)
    checked.start(project.root / "dataflow.yml", "--enable", "--env", "MODEL=a")
    assert checked.unit in required(), "a start with other settings keeps it"
    checked.doractl("stop", checked.name)
    checked.doractl("disable", checked.name)
    assert checked.unit not in required()
    assert not path.exists()


@pytest.mark.warns("cannot", "failed", "Failed", "is not a Python")
def test_a_bad_boot(checked: Cell, project: Project) -> None:
    flow = project.three_nodes()
    checked.start(flow)
    checked.doractl("enable", checked.name, "--boot-check")
    checked.doractl("stop", checked.name)
    flow.unlink()
    done = run("systemctl", "start", TARGET, check=False)
    assert done.returncode != 0
    assert run("systemctl", "is-active", TARGET, check=False).stdout != "active\n"
    wait_for("it has failed", lambda: checked.show("ActiveState") == "failed")


def test_users_have_no_boot_check(checked: Cell) -> None:
    words = ("doractl", "--user", "enable", "x", "--boot-check")
    done = run(
        "runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000", *words, check=False
    )
    assert done.returncode in (ExitCode.USAGE, ExitCode.NOT_FOUND)
    assert checked.is_gone

"""`start --push`: the files of a dataflow are copied to its machines first."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import NAME, PLACE, Flow
from tests.machines.wires import there
from tests.system.cells import Project, wait_for

pytestmark = pytest.mark.usefixtures("quiet_journals")


@pytest.fixture
def flow() -> Iterator[Flow]:
    """A dataflow of root whose files are on the head only."""
    flow = Flow({"gpu": "b"})
    shutil.rmtree(PLACE, ignore_errors=True)
    there("b", "rm", "-rf", PLACE)
    flow.write()
    Path(PLACE).chmod(0o755)
    yield flow
    flow.cell.doractl("stop", NAME, check=False)
    flow.cell.end()
    wait_for("nothing is left", lambda: not flow.left())
    shutil.rmtree(PLACE)
    there("b", "rm", "-rf", PLACE)


def refused(flow: Flow, *words: str) -> None:
    flow.refused(*words, code=ExitCode.BAD_INPUT, flags=("--push",))


@pytest.mark.warns("Files of machine gpu of dataflow flow differ: machine gpu runs another")
def test_the_files_come_first(flow: Flow) -> None:
    place = Project(Path(PLACE), is_new=False)
    place.write("dataflow.systemd.yml", "max_restarts: 1\n")
    place.write("more/data.txt", "1\n")
    Path(PLACE, "link").symlink_to("/etc/shadow")
    started = flow.start("--push")
    assert started.returncode == 0, started.stderr
    flow.wait_exchanging()
    found = there("b", "find", PLACE, "-printf", "'%P %u %y\\n'").stdout.splitlines()
    assert {"more/data.txt root f", "doubler.py root f", "link root l"} <= set(found)
    assert not [one for one in found if "systemd.yml" in one], "it is about the head"
    assert flow.cell.doractl("stop", NAME).returncode == 0
    place.write("more/data.txt", "2\n")
    flow.start("--push")
    assert there("b", "cat", f"{PLACE}/more/data.txt").stdout == "2\n"
    assert "another" not in flow.status()
    doubler = Path(PLACE) / "doubler.py"
    doubler.write_text(f"{doubler.read_text()}# changed\n")
    flow.cell.doractl("restart", NAME)
    differs = "3/3 nodes running; machine gpu runs another doubler.py than the one here"
    wait_for("it is said that b has the old file", lambda: flow.status() == differs)


def test_root_copies_nothing_of_others(flow: Flow) -> None:
    strange = Path(PLACE) / "strange"
    strange.mkdir()
    shutil.chown(strange, "alice")
    refused(flow, f"{strange} belongs to alice")
    assert there("b", "test", "-e", PLACE).returncode == 1
    strange.rmdir()
    there("b", f"mkdir {PLACE}; chown alice {PLACE}")
    refused(flow, "machine gpu", f"{PLACE} belongs to alice")
    assert not there("b", "ls", PLACE).stdout


def test_no_rsync_there(flow: Flow) -> None:
    there("b", "mv /usr/bin/rsync /usr/bin/rsync.away")
    try:
        refused(flow, "machine gpu", "rsync is not installed on b")
    finally:
        there("b", "mv /usr/bin/rsync.away /usr/bin/rsync")

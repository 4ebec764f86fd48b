"""A dataflow over several machines without root: alice's, in the user managers of each."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.machines.flows import NAME, PLACE, Flow
from tests.machines.journals import quiet_journals
from tests.machines.wires import there
from tests.system.cells import run, wait_for

HOME = Path("/home/alice")
HERE = HOME / "flow"
KEYS = ("id_ed25519", "known_hosts")


def alice(*words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """A command of alice on the head."""
    environment = ("env", "XDG_RUNTIME_DIR=/run/user/1000", f"HOME={HOME}")
    return run("runuser", "-u", "alice", "--", *environment, *words, check=check)


@pytest.fixture
def flow() -> Iterator[Flow]:
    """The files are alice's on both machines, and she can log in on b."""
    flow = Flow({"gpu": "b"})
    flow.bring()
    for key in KEYS:
        shutil.copy(f"/root/.ssh/{key}", HOME / ".ssh")
        shutil.chown(HOME / ".ssh" / key, "alice", "alice")
    shutil.copytree(PLACE, HERE)
    run("chown", "-R", "alice:alice", str(HERE))
    assert there("b", f"cp -r {PLACE} {HERE} && chown -R alice:alice {HERE}").returncode == 0
    with quiet_journals():
        yield flow
        alice("doractl", "stop", NAME, check=False)
    shutil.rmtree(HERE)
    there("b", "rm", "-r", str(HERE))
    for key in KEYS:
        (HOME / ".ssh" / key).unlink()
    wait_for("nothing is left", lambda: not flow.left())


def test_a_life_of_a_user(flow: Flow) -> None:
    del flow
    file = str(HERE / "dataflow.yml")
    started = alice("doractl", "start", file, "--name", NAME, "--machine=gpu=b")
    assert started.returncode == 0, started.stderr
    row = json.loads(alice("doractl", "list", NAME, "-o", "json").stdout)
    assert {node["node"]: node["machine"] for node in row["nodes"]} == {
        "source": "head",
        "doubler": "gpu",
        "sink": "head",
    }
    unit = there(
        "b", "systemctl", "--user", "show", "-P", "ActiveState", f"dora-{NAME}", user="alice"
    )
    assert unit.stdout == "active\n", unit.stderr
    assert not there("b", "systemctl", "-q", "list-units", f"dora-{NAME}*").stdout.strip()

    def heard() -> bool:
        return " got " in alice("doractl", "logs", NAME, "-n", "50").stdout

    wait_for("the sink hears more", heard)
    lines = alice("doractl", "logs", NAME).stdout.splitlines()
    assert {line.split()[0] for line in lines} == {"head", "gpu"}
    assert alice("doractl", "stop", NAME).returncode == 0

"""What the setting black_box costs: a storm of failures, and a disk that is full."""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.test_bundle import STORE

# The units of notices are installed below /usr/local.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("units_for_all")]

KILLED = (
    *("code=killed", "Failed with result", "status=69", "is lost", "failed: ", "was killed ("),
    *("daemon", "is not written", "connection"),
)
RESTARTS = (
    *("--restart-policy", "on-failure", "--max-restarts", "1000"),
    *("--restart-delay", "500ms", "--max-restart-delay", "500ms"),
)
ROUNDS, FAILURES = int(os.environ.get("ROUNDS", "2")), 5


@pytest.fixture
def bundles(cell: Cell) -> Iterator[Path]:
    """The directory of the bundles of the cell."""
    yield STORE / cell.name
    subprocess.run(["umount", "-q", str(STORE / cell.name)], check=False)
    shutil.rmtree(STORE / cell.name, ignore_errors=True)


def ready(cell: Cell) -> int:
    """The runner of a dataflow of which all nodes are ready, or 0."""
    is_up = cell.show("ActiveState") == "active" and cell.status.stage == "running"
    return int(cell.show("MainPID")) if is_up else 0


def restart_seconds(cell: Cell) -> float:
    """How long a restart takes after kill -9 of the supervisor process, until all is ready."""
    old = wait_for("it runs", lambda: ready(cell))
    begun = time.monotonic()
    os.kill(old, signal.SIGKILL)
    wait_for("it runs again", lambda: ready(cell) not in (0, old), 60)
    return time.monotonic() - begun


@pytest.mark.warns(*KILLED)
def test_a_storm_of_failures(cell: Cell, project: Project, bundles: Path) -> None:
    """As many failures as restarts allow fill no disk, and slow no restart down."""
    flow = project.three_nodes()
    seconds: dict[str, list[float]] = {"no": [], "keep=2,size=4M": []}
    refused = f"DORA_DATAFLOW_NAME={cell.name}", "DORA_EVENT=bundle-refused"
    for number in range(ROUNDS):
        for box, found in seconds.items():
            cell.start(flow, "--black-box", box, *RESTARTS)
            found += [restart_seconds(cell) for _ in range(FAILURES)]
            # A dataflow that has been stopped meanwhile has no setting that asks for a bundle.
            if box != "no" and not number:
                wait_for("the first one is written", lambda: [*bundles.glob("*.tar")], 120)
            elif box != "no":
                wait_for("the later ones are suppressed", lambda: journalctl(*refused), 120)
            cell.doractl("stop", cell.name)
    without, with_box = map(median, seconds.values())
    print(f"restart: {without:.2f} s without, {with_box:.2f} s with a black box")
    # In few rounds, whatever else this machine does slows a restart down more than a bundle.
    assert ROUNDS < 10 or with_box < 1.5 * without, seconds
    assert journalctl(*refused)
    # On a slow machine one of the kills may come when nodes end already, which is another cause.
    rows = json.loads(cell.doractl("bundles", cell.name, "-o", "json").stdout)
    assert 1 <= len({(one["node"], one["cause"]) for one in rows}) == len(rows) <= 2
    assert sum(one.stat().st_size for one in bundles.iterdir()) < 4 << 20


@pytest.mark.warns(*KILLED)
def test_a_full_disk_costs_the_bundle_only(cell: Cell, project: Project, bundles: Path) -> None:
    bundles.mkdir(parents=True)
    run("mount", "-t", "tmpfs", "-o", "size=900k", "tmpfs", str(bundles))
    cell.start(project.three_nodes(), "--black-box", "yes", *RESTARTS)
    restart_seconds(cell)
    refused = f"DORA_DATAFLOW_NAME={cell.name}", "DORA_EVENT=bundle-refused"
    assert "of the disk free" in wait_for("its event", lambda: journalctl(*refused), 60)
    assert ready(cell), "it runs"
    assert not [one for one in bundles.iterdir() if one.name != ".refused"]
    sync_journal()
    said = cell.doractl("why", cell.name).stdout
    assert "Bundle:   1 not written, the last: cannot write a bundle to " in said
    row = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    assert row["bundles"]["refused"] == 1
    assert row["bundles"]["newest"] is None

"""A device that the kernel really adds and removes while a dataflow runs, in the sandbox."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, run, wait_for
from tests.system.needs.scene import node_of, wait_running, wait_waiting
from tests.system.needs.uhid import load_modules, plugged

ARM = """
import os, sys
from dora import Node
node = Node()
for path in sys.argv[1:]:
    try:
        os.close(os.open(path, os.O_RDWR))
        print("opened", path, flush=True)
    except OSError as error:
        print(error.strerror, path, flush=True)
for event in node:
    pass
"""
LINK = Path("/dev/robot-arm")
RULE = f'KERNEL=="hidraw*", MODE="0666", SYMLINK+="{LINK.name}"\n'
OTHER = Path("/dev/uhid")
"""A device of another driver, which everybody may open as far as its mode is concerned."""


@pytest.fixture
def rule() -> Iterator[None]:
    """Have udev let everybody use the device, by a name that does not depend on its number."""
    load_modules()
    rules = Path("/run/udev/rules.d/70-robot-arm.rules")
    rules.parent.mkdir(parents=True, exist_ok=True)
    rules.write_text(RULE)
    run("systemctl", "start", "systemd-udevd")
    run("udevadm", "control", "--reload")
    OTHER.chmod(0o666)
    yield
    rules.unlink()
    run("udevadm", "control", "--reload")
    OTHER.chmod(0o600)


def robot(project: Project) -> Path:
    """An arm that needs its device, and a node beside it."""
    project.three_nodes()
    project.write("arm.py", ARM)
    project.write("dataflow.systemd.yml", f"nodes: {{arm: {{needs: {LINK}}}}}\n")
    return project.write(
        "dataflow.yml",
        "nodes:\n"
        f"  - {{id: arm, path: arm.py, args: {LINK} {OTHER}, "
        "inputs: {tick: dora/timer/millis/500}}\n"
        "  - {id: sink, path: sink.py, inputs: {double: dora/timer/millis/500}}\n",
    )


@pytest.mark.emulator
@pytest.mark.usefixtures("rule")
def test_a_device_is_plugged_in_and_unplugged_and_plugged_in(cell: Cell, project: Project) -> None:
    cell.start(robot(project), "--device", "char-hidraw")
    wait_waiting(cell, "arm", LINK)
    assert not LINK.exists()
    use = [f"opened {LINK}", f"Operation not permitted {OTHER}"]
    with plugged("arm"):
        wait_running(cell)
        wait_for("the node has used it", lambda: cell.messages("arm") == use)
        sink = cell.status.nodes["sink"].pid
        cell.wait_exchanging()
    wait_waiting(cell, "arm", LINK)
    with plugged("arm"):
        wait_running(cell)
        wait_for("the next one has used it", lambda: cell.messages("arm") == 2 * use)
        assert cell.status.nodes["sink"].pid == sink
        assert (node_of(cell, "arm")["restarts"], cell.show("NRestarts")) == (0, "0")
        cell.doractl("stop", cell.name)

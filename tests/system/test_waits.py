"""What uses the CPUs of a node: busy processes, and the interrupts of a device that it needs."""

import json
import os
import re
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.host.rivals import Interrupts
from dora_systemd.values import cpu_numbers
from tests.system.cells import Cell, Project, run, wait_for

LAST = max(os.sched_getaffinity(0))
# Goes to that CPU by itself: containers have no cpuset controller that would put it there.
BUSY = """
import os, threading
from dora import Node
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
def spin():
    while True:
        pass
threading.Thread(target=spin, daemon=True).start()
for event in Node():
    pass
"""


@contextmanager
def burners(count: int) -> Iterator[set[int]]:
    """Processes that want all of the last CPU."""
    command = ["taskset", "--cpu-list", str(LAST), sys.executable, "-c", "while True: pass"]
    with ExitStack() as stack:
        # The kernel shares the time of a CPU among sessions: each of them has one of its own.
        found = [
            stack.enter_context(subprocess.Popen(command, start_new_session=True))
            for _ in range(count)
        ]
        for one in found:
            stack.callback(one.kill)
        yield {one.pid for one in found}


@pytest.fixture
def device(project: Project) -> Iterator[tuple[Path, int]]:
    """A disk of this machine, and a CPU that handles its interrupts."""
    known = Interrupts()
    for link in sorted(Path("/sys/dev/block").iterdir()):
        major, minor = map(int, link.name.split(":"))
        number = os.makedev(major, minor)
        for one, cpus in known.of_number(number, is_block=True):
            if one.total and cpus:
                path = project.root / "disk"
                os.mknod(path, 0o644 | stat.S_IFBLK, number)
                yield path, cpu_numbers(cpus)[0]
                return
    pytest.skip("this machine has no disk with interrupts")


def test_a_busy_process_on_the_cpu_of_a_node(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", BUSY)
    cell.start(flow, f"--node=sink:cpus={LAST}")

    remedies: list[str] = []

    def wait_because_of(pids: set[int]) -> dict[str, Any]:
        report = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
        remedies.extend(report["remedies"])
        # On a busy machine there may be others that have more of the CPU.
        own = (one for one in report["cpu_waits"] if one["node"] == "sink")
        return next((one for one in own if pids & {it["pid"] for it in one["processes"]}), {})

    with burners(3) as pids:
        wait = wait_for("a wait because of them", lambda: wait_because_of(pids), 60)
        text = cell.doractl("why", cell.name).stdout
    assert wait["waited_percent"] >= 20
    assert wait["cpus"] == str(LAST)
    assert re.search(rf"\n  CPU: +sink waited \d+% of .* for a CPU: cpus {LAST} also have", text)
    assert f"keep other processes away from cpus {LAST}" in "\n".join(remedies)


def test_interrupts_of_a_needed_device(
    cell: Cell, project: Project, device: tuple[Path, int]
) -> None:
    path, cpu = device
    cell.start(project.three_nodes(), f"--node=sink:needs={path},cpus={cpu}")
    wait_for("messages", lambda: cell.messages("sink"))
    found = json.loads(run("doractl", cell.scope.flag, "doctor", "-o", "json", check=False).stdout)
    (one,) = [one for one in found if one["topic"] == "interrupts"]
    assert one["state"] == "note"
    words = (
        rf"{cell.name}/sink: cpus {cpu} also have the interrupts of .*\({re.escape(str(path))}\)"
    )
    assert re.fullmatch(words, one["text"])
    assert re.search(r"as root: .*/proc/irq/|give the node other cpus", one["remedy"])

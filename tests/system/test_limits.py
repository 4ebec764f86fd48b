"""Limits that nothing would hold up are refused; the lab's container has no controllers."""

import os
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import mount_point, read_controllers
from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project
from tests.system.refusals import Refusal, check_refusals

MOUNT = mount_point()

BAD_LIMITS = (
    *("--memory-limit=0", "--memory-limit=-1", "--memory-limit=4 gigs", "--memory-limit=4"),
    *("--cpu-limit=0", "--cpu-limit=-2", "--cpu-limit=two", "--tasks-limit=0"),
    *("--cpu-weight=0", "--io-weight=10001", "--nice=20", "--realtime=0", "--device=video0"),
    *("--node=sink", "--node=sink:memory_limit=0", "--node=sink:mem=1G"),
    *("--node=sink:cpu_limit=-1", "--node=:cpu_limit=1"),
)


def test_bad_limits(cell: Cell, project: Project) -> None:
    flow = str(project.three_nodes())
    refusals = [Refusal([flow, limit], ExitCode.USAGE, limit.split("=")[0]) for limit in BAD_LIMITS]
    there = "nodes: source, doubler, sink"
    refusals.append(Refusal([flow, "--node=x:cpu_limit=1"], ExitCode.BAD_INPUT, there))
    refusals.append(Refusal([flow, "--node=Sink:cpu_limit=1"], ExitCode.BAD_INPUT, "mean sink?"))
    check_refusals(cell, project, refusals)


def test_bad_limits_in_the_settings_file(cell: Cell, project: Project) -> None:
    flow = str(project.three_nodes())
    for text, words in (
        ("memory_limit: 0", "memory_limit in"),
        ("nodes: {sink: {memory_limit: 4 gigs}}", "nodes.sink.memory_limit in"),
        ("nodes: {snik: {memory_limit: 1G}}", "did you mean sink?"),
        ("nodes: {sink: {realtime: 5}}", "unknown key 'realtime'"),
        ("nodes: {sink: {memory: 1G}}", "did you mean memory_"),
    ):
        project.write("dataflow.systemd.yml", text)
        check_refusals(cell, project, [Refusal([flow], ExitCode.BAD_INPUT, words)])


def test_limits_without_controllers(cell: Cell, project: Project) -> None:
    """Never pretend: neither for the dataflow nor for a node, nor by a property."""
    missing = {"cpu", "memory", "pids", "io"} - read_controllers(MOUNT)
    flow = str(project.three_nodes())
    flags = {
        "memory": ("--memory-limit=1G", "--node=sink:memory_limit=1G", "--property=MemoryHigh=1G"),
        "cpu": ("--cpu-limit=1", "--cpu-weight=50"),
        "pids": ("--tasks-limit=100",),
        "io": ("--io-weight=50", "--node=sink:io_weight=50"),
    }
    words = "systemd has no"
    check_refusals(
        cell,
        project,
        [
            Refusal([flow, flag], ExitCode.NO_SYSTEMD, f"{words} '{controller}' cgroup controller")
            for controller in missing
            for flag in flags[controller]
        ],
    )


def test_nice_and_devices(cell: Cell, project: Project) -> None:
    done = cell.start(project.three_nodes(), "--device=/dev/video99:r", "--nice=3")
    assert "doractl: there is no device /dev/video99" in done.stderr
    assert "DeviceAllow=/dev/video99 r" in cell.doractl("show", cell.name).stdout
    cell.wait_exchanging()
    (pid,) = cell.pids("node-sink")
    assert os.getpriority(os.PRIO_PROCESS, pid) == 3


BAD_CHANGES = {
    (): ExitCode.USAGE,
    ("--memory-limit=0",): ExitCode.USAGE,
    ("--memory-limit=4 gigs",): ExitCode.USAGE,
    ("--nice=5",): ExitCode.USAGE,
    ("--node=sink",): ExitCode.USAGE,
    ("--node=x:cpu_limit=infinity",): ExitCode.BAD_INPUT,
    ("--node=sink:cpu_limit=infinity", "--node=Sink:cpu_limit=infinity"): ExitCode.BAD_INPUT,
}


def test_bad_changes(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    before = cell.doractl("show", cell.name).stdout
    for flags, code in BAD_CHANGES.items():
        done = cell.doractl("set", cell.name, *flags, check=False)
        assert (done.returncode, done.stdout) == (code, ""), (flags, done.stderr)
        assert len(done.stderr.splitlines()) == 2, done.stderr
    assert cell.doractl("set", "x" + cell.name, "--cpu-limit=1", check=False).returncode == (
        ExitCode.NOT_FOUND
    )
    missing = {"memory": "--memory-limit=1G", "cpu": "--cpu-limit=1"}.items()
    for flag in (f for controller, f in missing if controller not in read_controllers(MOUNT)):
        done = cell.doractl("set", cell.name, flag, check=False)
        assert done.returncode == ExitCode.NO_SYSTEMD, done.stderr
    assert cell.doractl("show", cell.name).stdout == before


def test_changes_are_remembered_while_the_dataflow_is_there(cell: Cell, project: Project) -> None:
    """Lifting what is not limited needs no controller: the way there and back can be seen."""
    cell.start(project.three_nodes())
    cell.doractl("set", cell.unit, "--node=sink:cpu_limit=infinity", "--tasks-limit=infinity")
    (run, unit) = cell.status.run, cell.doractl("show", cell.name).stdout
    assert "DORA_SYSTEMD_SET=sink:cpu_limit=infinity" in unit
    cell.doractl("restart", cell.name)
    assert cell.status.run != run
    assert cell.doractl("show", cell.name).stdout == unit
    (pid,) = cell.pids("node-sink")
    assert b"DORA_SYSTEMD_SET" not in Path(f"/proc/{pid}/environ").read_bytes()
    cell.doractl("stop", cell.name)
    assert not list(Path("/run/systemd").glob(f"*/{cell.unit}*"))

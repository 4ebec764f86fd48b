"""The stack of a node that a signal ended, with real dumps of Python and systemd-coredump."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.system.cells import Cell, Project, run, sync_journal, wait_for

CRASHES = (
    "crashed",
    "signal SIGSEGV",
    "Segmentation",
    "Failed with",
    "status=69",
    "dumped core",
    "node exited with",
)
CRASHER = """
import ctypes, os, signal, sys
from dora import Node
def read_frame(how):
    if how == "c":
        ctypes.CDLL(None).puts(1)
    if how == "extension":
        import pyarrow
        pyarrow.foreign_buffer(1, 64).equals(pyarrow.py_buffer(b"x" * 64))
    os.kill(os.getpid(), signal.SIGSEGV)
node = Node()
print("no camera", file=sys.stderr, flush=True)
for event in node:
    read_frame(os.environ["HOW"])
"""
FLOW = "nodes: [{id: bad, path: bad.py, inputs: {tick: dora/timer/millis/300}}]\n"


def verdict(cell: Cell) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    return found


def crash(cell: Cell, project: Project, how: str, *options: str) -> dict[str, Any]:
    """What `why` knows of a node that has crashed; its text is checked on the way."""
    project.write("bad.py", CRASHER)
    cell.start(project.write("flow.yml", FLOW), "--env", f"HOW={how}", *options)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    sync_journal()
    found = verdict(cell)
    text = cell.doractl("why", cell.name).stdout
    assert len(text.splitlines()) <= 45
    assert all(one["function"] in text for one in found["stack"])
    assert "Fatal Python error" not in text
    return found


def functions(found: dict[str, Any], language: str) -> list[str]:
    return [one["function"] for one in found["stack"] if one["language"] == language]


@pytest.mark.warns(*CRASHES)
def test_the_stack_of_python(cell: Cell, project: Project) -> None:
    found = crash(cell, project, "c")
    assert functions(found, "python")[:2] == ["read_frame", "<module>"]
    assert found["stack"][-2]["place"].endswith("/bad.py:6")
    assert [one["text"] for one in found["last_lines"]] == ["no camera"]


@pytest.mark.warns(*CRASHES)
def test_who_wants_no_stack(cell: Cell, project: Project) -> None:
    found = crash(cell, project, "c", "--env", "PYTHONFAULTHANDLER=", "-p", "LimitCORE=0")
    assert found["stack"] == []
    assert [one["text"] for one in found["last_lines"]] == ["no camera"]


# A record as systemd-coredump writes it.
WRITER = r"""
import socket, struct, sys
fields = dict(one.split("=", 1) for one in sys.argv[1:])
fields["MESSAGE"] = "dumped core.\n\nStack trace of thread 1:\n#0  0x1 _ZN3Cam4grabEv (cam + 0x9)\n"
fields["MESSAGE_ID"] = "fc2e22bc6ee647b6b90729ab34a250b1"
data = b"".join(
    key.encode() + b"\n" + struct.pack("<Q", len(text.encode())) + text.encode() + b"\n"
    for key, text in fields.items()
)
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
    journal.sendto(data, "/run/systemd/journal/socket")
"""


@pytest.mark.warns(*CRASHES)
def test_only_systemd_coredump_is_believed(cell: Cell, project: Project) -> None:
    """The writers are told apart by what journald says of them."""
    found = crash(cell, project, "kill", "-p", "LimitCORE=0")
    (end,) = cell.journal("DORA_EVENT=node-crashed")
    # The kernel gives the second of the crash; the record of the end may be of the next one.
    pid, at_us = end["DORA_NODE_PID"], found["at_us"]
    user = cell.scope.is_user
    group = f"/{cell.unit}/node-bad"
    fields = [
        f"COREDUMP_PID={pid}", "COREDUMP_SIGNAL=11", f"COREDUMP_CGROUP={group}",
        f"COREDUMP_TIMESTAMP={at_us // 1_000_000 * 1_000_000}", f"COREDUMP_UID={cell.scope.uid}",
        f"COREDUMP_{'USER_' if user else ''}UNIT={cell.unit}",
    ]  # fmt: skip
    words = ("/usr/bin/python3", "-c", WRITER, *fields)
    run(*words)
    run("systemd-run", "--wait", "--quiet", "--unit=systemd-coredump-0.service", "--", *words)
    sync_journal()
    assert verdict(cell)["stack"] == found["stack"]
    account = [f"--property=User={cell.scope.uid}"] if user else []
    unit = f"--unit=systemd-coredump@7-{pid}-0.service"
    run("systemd-run", "--wait", "--quiet", unit, *account, "--", *words)
    sync_journal()
    seen = verdict(cell)
    assert functions(seen, "native") == ["Cam::grab"]
    assert functions(seen, "python") == functions(found, "python")


@pytest.mark.emulator
@pytest.mark.warns(*CRASHES)
@pytest.mark.parametrize(
    ("how", "function"),
    [("c", "puts"), ("extension", "arrow::Buffer::Equals")],
    ids=["c", "extension"],
)
def test_the_stack_of_a_core_dump(cell: Cell, project: Project, how: str, function: str) -> None:
    settings = Path("/etc/systemd/coredump.conf.d/lab.conf")
    settings.parent.mkdir(exist_ok=True)
    settings.write_text("[Coredump]\nCompress=no\n")  # that takes minutes here
    crash(cell, project, how)
    wait_for("the stack is there", lambda: functions(verdict(cell), "native"))
    found = verdict(cell)
    assert function in "".join(functions(found, "native")[:2])
    assert "read_frame" in functions(found, "python")
    findings = json.loads(cell.doractl("doctor", "-o", "json", check=False).stdout)
    assert [one["state"] for one in findings if one["topic"] == "core dumps"] == ["ok"]

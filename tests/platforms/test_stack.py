"""The stack that systemd-coredump of this release writes of a node that a signal has ended.

The kernel gives core dumps of processes in a container to the host, where they are files `core`. So
a copy of the node crashes, which leaves its core here. Then systemd-coredump is called as the
kernel would, for the node itself, which a signal ends.
"""

import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from signal import SIGSEGV
from typing import Any

import pytest

from tests.deb.packages import install
from tests.platforms.test_packages import doractl, show, start
from tests.system.cells import Project, run, sync_journal, wait_for, wait_no_process

CORE_PATTERN = Path("/proc/sys/kernel/core_pattern")
DUMPED = "fc2e22bc6ee647b6b90729ab34a250b1"
UNPACKED = Path("/opt/coredump")
PATTERN = re.compile(r"kernel\.core_pattern=\|(.*)")
CRASHER = """
import ctypes, os, pathlib, resource, signal, time
from dora import Node
def crash(how):
    if how == "c":
        ctypes.CDLL(None).puts(1)
    import pyarrow
    pyarrow.foreign_buffer(1, 64).equals(pyarrow.py_buffer(b"x" * 64))
def read_frame(how):
    resource.setrlimit(resource.RLIMIT_CORE, (resource.RLIM_INFINITY,) * 2)
    if (copy := os.fork()) == 0:
        os.chdir(os.environ["CORES"])
        crash(how)
    os.waitpid(copy, 0)
    print("core", os.getpid(), flush=True)
    while not pathlib.Path(os.environ["CORES"], "taken").exists():
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGSEGV)
for event in Node():
    read_frame(os.environ["HOW"])
"""
FLOW = "nodes: [{id: bad, path: bad.py, inputs: {tick: dora/timer/millis/300}}]\n"


@pytest.fixture(scope="module", autouse=True)
def coredump() -> None:
    """systemd-coredump, which listens for what the kernel would give it."""
    if CORE_PATTERN.read_text().strip() != "core":
        pytest.skip("the host keeps no core dumps in files")
    install()
    run("cp", "--archive", "--force", f"{UNPACKED}/.", "/")
    run("ldconfig")
    run("systemd-sysusers")
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "systemd-coredump.socket")


@pytest.fixture
def root() -> Iterator[Path]:
    place = Path(tempfile.mkdtemp(prefix="crash-", dir="/var/tmp"))
    place.chmod(0o755)
    (place / "cores").mkdir()
    (place / "cores").chmod(0o777)  # the node is another user
    yield place
    doractl("root", "stop", "robot", check=False)
    shutil.rmtree(place)
    wait_no_process()


def why() -> dict[str, Any]:
    sync_journal()
    found: dict[str, Any] = json.loads(doractl("root", "why", "robot", "-o", "json").stdout)
    return found


def functions() -> list[str]:
    return [str(one["function"]) for one in why()["stack"]]


def pass_on(pid: int, core: Path) -> None:
    """Call systemd-coredump as the kernel would, see core(5)."""
    settings = Path("/usr/lib/sysctl.d/50-coredump.conf").read_text()
    (command,) = PATTERN.findall(settings)
    told = os.pidfd_open(pid)
    owner = Path(f"/proc/{pid}").stat()
    values = {
        "%P": pid, "%u": owner.st_uid, "%g": owner.st_gid, "%s": int(SIGSEGV),
        "%t": int(time.time()), "%c": 2**63 - 1, "%h": "lab", "%d": 1, "%F": told, "%I": pid,
    }  # fmt: skip
    words = [str(values.get(word, word)) for word in command.split()]
    with core.open("rb") as data:
        os.set_inheritable(told, True)
        child = os.posix_spawn(
            words[0], words, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, data.fileno(), 0)]
        )
        assert os.waitpid(child, 0)[1] == 0
    os.close(told)


@pytest.mark.parametrize(
    ("how", "function"), [("c", "puts"), ("extension", "arrow::Buffer::Equals")]
)
def test_the_function_in_which_it_crashed(root: Path, how: str, function: str) -> None:
    project, cores = Project(root / "project"), root / "cores"
    project.write("bad.py", CRASHER)
    flow = project.write("flow.yml", FLOW)
    options = ("--sandbox", "none", "--env", f"HOW={how}", "--env", f"CORES={cores}")
    start("root", flow, *options, "-p", "LimitCORE=infinity")

    life = show("root", "InvocationID")

    def ready() -> list[str]:
        words = ("journalctl", "-q", "-o", "cat", f"_SYSTEMD_INVOCATION_ID={life}")
        return re.findall("^core ([0-9]+)$", run(*words).stdout, re.MULTILINE)

    (pid,) = map(int, wait_for("its copy has crashed", ready, 60))
    (core,) = cores.glob("core*")
    pass_on(pid, core)
    # systemd 262 needs the process, which the kernel keeps meanwhile.
    record = ("journalctl", "-q", "-o", "cat", f"MESSAGE_ID={DUMPED}", f"COREDUMP_PID={pid}")
    wait_for("it is recorded", lambda: run(*record, check=False).stdout)
    (cores / "taken").touch()
    wait_for("it has failed", lambda: show("root", "ActiveState") == "failed", 60)
    wait_for("its stack", lambda: function in "".join(functions()[:2]))
    text = doractl("root", "why", "robot").stdout
    assert function in text
    assert "read_frame" in text

"""What the lab promises to every other system test."""

import subprocess
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.lab

BURN = """
import time
from pathlib import Path
_, _, group = Path("/proc/self/cgroup").read_text().strip().rpartition("::")
start = time.monotonic()
while time.monotonic() - start < 3:
    pass
print(Path(f"/sys/fs/cgroup{group}/cpu.stat").read_text())
"""


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_systemd_is_the_first_process() -> None:
    assert Path("/proc/1/comm").read_text() == "systemd\n"
    assert run("systemctl", "--failed", "--plain", "--no-legend").stdout == ""
    assert run("systemctl", "is-system-running").stdout == "running\n"


def test_user_managers_are_up() -> None:
    for unit in ("user@1000.service", "user@1001.service"):
        assert run("systemctl", "is-active", unit).stdout == "active\n"
    done = run("systemctl", "--user", "--machine=alice@.host", "is-system-running")
    assert done.stdout == "running\n", done.stderr


def test_no_network_but_loopback() -> None:
    assert [path.name for path in Path("/sys/class/net").iterdir()] == ["lo"]


def test_journal_is_persistent() -> None:
    assert list(Path("/var/log/journal").glob("*/system.journal"))


def test_python_has_dora() -> None:
    done = run("python", "-c", "import dora, pyarrow; print(pyarrow.array([1])[0])")
    assert done.stdout == "1\n", done.stderr


def test_python_has_no_numpy() -> None:
    """pyarrow would import numpy, and each node then start for twice as long."""
    assert run("python", "-c", "import numpy").returncode


@pytest.mark.parametrize("user", ["alice", "bob", "dora"])
def test_users_can_run_dora_and_read_the_checkout(user: str) -> None:
    done = run("setpriv", f"--reuid={user}", "--clear-groups", "dora", "--version")
    assert "1.1.0" in done.stdout, done.stderr
    assert not run("setpriv", f"--reuid={user}", "cat", "/src/pyproject.toml").returncode


@pytest.mark.vm
def test_controllers() -> None:
    controllers = Path("/sys/fs/cgroup/cgroup.controllers").read_text().split()
    assert {"cpu", "io", "memory", "pids"} <= set(controllers)


@pytest.mark.vm
def test_memory_limit_kills() -> None:
    hog = ("/usr/bin/python3", "-c", "x = bytearray(300 << 20)")
    done = run("systemd-run", "--wait", "--collect", "--property=MemoryMax=64M", *hog)
    assert "oom-kill" in done.stderr


@pytest.mark.vm
def test_cpu_quota_throttles() -> None:
    burn = ("/usr/bin/python3", "-c", BURN)
    done = run("systemd-run", "--wait", "--pipe", "--collect", "--property=CPUQuota=20%", *burn)
    assert done.returncode == 0
    stat = dict(line.split() for line in done.stdout.splitlines() if line)
    # A slow machine gives the process less than it may have in some of the periods, not in all.
    assert int(stat["nr_throttled"]) > 0, stat


@pytest.mark.vm
def test_clock_is_not_the_snapshots() -> None:
    assert time.time() - Path("/src").stat().st_ctime < 3600

"""A cgroup of our own for each run, whatever the host's layout of cgroups is.

The lab works in a mount namespace of its own with a second view of cgroup v2 at the usual place.
So systemd-nspawn finds a plain v2 host, and the host's own mounts are neither used nor changed.
"""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from lab.errors import LabError

ROOT = Path("/sys/fs/cgroup")
MARK = "LAB_NAMESPACE"
USAGE = "LAB_USAGE"
"""The variable with the file for the processor time of containers: their processes are not ours."""


def enter_namespace() -> None:
    """Starts this program again inside; what it mounts there ends with its last process."""
    here = str(Path("/proc/self/ns/mnt").readlink())
    outside = os.environ.setdefault(MARK, here)
    if outside == here:
        unshare = ["unshare", "--mount", "--propagation", "private", "--"]
        os.execvp(unshare[0], [*unshare, sys.executable, *sys.argv])
    mount_view()


def is_systemd_host() -> bool:
    return Path("/run/systemd/system").is_dir()


def mount_view() -> None:
    if (ROOT / "cgroup.procs").exists():
        return
    result = subprocess.run(view_command(), capture_output=True, text=True, check=False)
    if result.returncode:
        raise LabError(f"mount cgroup v2: {result.stderr}", "needs root and a kernel with cgroup2")


def view_command() -> list[str]:
    """A new mount would reset the options of the host's (nsdelegate is one flag for all)."""
    for line in Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines():
        if " - cgroup2 " in line:
            return ["mount", "--bind", line.split()[4], str(ROOT)]
    return ["mount", "-t", "cgroup2", "cgroup2", str(ROOT)]


def enter_command(name: str) -> tuple[list[str], Path]:
    """The words that start a command in the new cgroup, and where that cgroup will be."""
    if is_systemd_host():
        scope = ["systemd-run", "--quiet", "--scope", "--property=Delegate=yes"]
        return [*scope, f"--unit={name}", "--"], ROOT / "system.slice" / f"{name}.scope"
    path = ROOT / f"dora-systemd-{name}"
    return ["sh", "-c", f'mkdir {path} && exec "$@"', "sh", *join_command(path)], path


def join_command(path: Path) -> list[str]:
    return ["sh", "-c", f'echo $$ > {path}/cgroup.procs && exec "$@"', "sh"]


def note_usage(path: Path) -> None:
    """Add what all in a cgroup have used to the file of LAB_USAGE, if there is one."""
    file = os.environ.get(USAGE)
    if file:
        with suppress(OSError), Path(file).open("a", encoding="ascii") as used:
            stat = (path / "cpu.stat").read_text(encoding="ascii").split()
            used.write(f"{int(stat[stat.index('usage_usec') + 1]) / 1e6:.2f}\n")

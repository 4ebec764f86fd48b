"""The cgroup tree: numbers read from it, and what the runner does in its own delegated part.

Everything here follows the kernel's "Control Group v2" document. A group is named as systemd and
/proc/PID/cgroup name it: by its path from the root of the hierarchy, "/dora.slice/dora-x.service".
"""

import contextlib
import errno
import io
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from itertools import islice
from pathlib import Path

from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.decisions.resources.usage import Usage
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_node_id
from dora_systemd.values import INFINITY, SECOND

NODE_PREFIX = "node-"
SUPERVISOR = "supervisor"
"""The group of the runner and of dora's own processes, below that of the unit."""
MAX_GROUPS = 300
"""Groups that are looked at where nobody says which: the nodes' user can make any number."""
MAX_PROCESSES = 5000
"""Processes that are counted one by one where there is no memory controller."""
_MAX_ENTRIES = 10_000
MOUNTS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified"))

_ABSENT = (errno.ENOENT, errno.ENODEV, errno.EOPNOTSUPP, errno.ENOTSUP)


@cache
def mount_point() -> Path:
    """Where the cgroup2 hierarchy is mounted; hybrid systems have it one level deeper.

    Raises DoraSystemdError (NO_SYSTEMD) when there is none.
    """
    for place in MOUNTS:
        if (place / "cgroup.procs").exists():
            return place
    raise DoraSystemdError(
        "cannot find the cgroup v2 hierarchy below /sys/fs/cgroup",
        "dora-systemd needs Linux with cgroup v2, as systemd 252 and newer set it up",
        ExitCode.NO_SYSTEMD,
    )


def group_path(group: str) -> Path:
    """The directory of `group` ("/a/b", as systemd's ControlGroup= property gives it)."""
    return mount_point() / group.lstrip("/")


def own_group() -> str:
    """The group of this process: the "0::" line of /proc/self/cgroup, see cgroups(7)."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        if line.startswith("0::"):
            return line[3:]
    return "/"


def node_groups(path: Path) -> dict[str, Path]:
    """Directories of the node groups below a unit's `path`, by node id."""
    with contextlib.suppress(OSError):
        return {
            one.name.removeprefix(NODE_PREFIX): one
            for one in sorted(path.iterdir())
            if one.name.startswith(NODE_PREFIX) and one.is_dir()
        }
    return {}


def shown_groups(path: Path, nodes: Iterable[str] = ()) -> dict[str, Path]:
    """The groups of `nodes` that are there, or MAX_GROUPS of those that may be of nodes.

    For a look from outside: the nodes' user can make groups there, of any name and number.
    """
    names = [f"{NODE_PREFIX}{node}" for node in nodes]
    with contextlib.suppress(OSError):
        if not names:
            with os.scandir(path) as entries:
                found = [one.name for one in islice(entries, _MAX_ENTRIES)]
            names = sorted(filter(_is_node_group, found))[:MAX_GROUPS]
        groups = (path / name for name in names)
        return {one.name.removeprefix(NODE_PREFIX): one for one in groups if one.is_dir()}
    return {}


def _is_node_group(name: str) -> bool:
    return name.startswith(NODE_PREFIX) and is_node_id(name.removeprefix(NODE_PREFIX))


def read_usage(path: Path) -> Usage:
    """CPU and memory of one group with all below it; zero for a group that has just gone.

    Without a memory controller the memory is the sum of the processes' resident sets.
    """
    current, cpu = read_number(path / "memory.current"), read_cpu(path)
    if current is None:
        some = islice(_pids(islice(_tree(path), MAX_GROUPS)), MAX_PROCESSES)
        memory = sum(map(_resident_bytes, some))
        return cpu._replace(memory=memory, cpu_max=_read_share(path / "cpu.max"))
    return cpu._replace(
        memory=current,
        memory_peak=read_number(path / "memory.peak"),
        memory_max=read_number(path / "memory.max"),
        cpu_max=_read_share(path / "cpu.max"),
    )


def read_cpu(path: Path) -> Usage:
    """CPU time and throttling of a group alone; there even without a cpu controller."""
    numbers = read_numbers(path / "cpu.stat")
    throttling = numbers.get("nr_periods", 0), numbers.get("nr_throttled", 0)
    return Usage(numbers.get("usage_usec", 0), throttling=throttling)


def read_numbers(path: Path) -> dict[str, int]:
    """The numbers of a control file with one KEY NUMBER in a line; {} where there is none."""
    pairs = (line.partition(" ") for line in read_text(path).splitlines())
    return {key: int(value) for key, _, value in pairs}


def pids(path: Path) -> list[int]:
    """The processes of a group and of all groups below it."""
    return list(_pids(_tree(path)))


def _pids(groups: Iterable[Path]) -> Iterator[int]:
    return (int(pid) for one in groups for pid in read_text(one / "cgroup.procs").split())


def is_populated(path: Path) -> bool:
    """Whether any process is in the group or below it."""
    return "populated 1" in read_text(path / "cgroup.events").splitlines()


def make_group(path: Path) -> None:
    """Make one group; one that is there already is fine. Raises OSError."""
    path.mkdir(exist_ok=True)


def remove_group(path: Path) -> None:
    """Remove a group that has no process; one that is gone or still busy is left as it is."""
    with contextlib.suppress(OSError):
        path.rmdir()


def read_controllers(path: Path) -> frozenset[str]:
    """The controllers that a group has been given, which it can give to those below it."""
    return frozenset(read_text(path / "cgroup.controllers").split())


def enable_controllers(path: Path) -> None:
    """Give the groups below `path` every controller that `path` itself has been given.

    What the kernel does not offer (no controllers at all, in some containers) is passed over.
    """
    for name in sorted(read_controllers(path)):
        _write(path / "cgroup.subtree_control", f"+{name}")


def kill_as_one(path: Path) -> None:
    """Have the kernel kill all of a group when one of its processes uses too much memory."""
    _write(path / "memory.oom.group", "1")


def limit_group(path: Path, limits: NodeLimits) -> None:
    """Limit a node's group. Raises DoraSystemdError for a limit that does not take hold."""
    for file, text in limits.files().items():
        try:
            is_limited = _write(path / file, text)
            reason = f"its group has no {file}"
        except OSError as error:
            is_limited, reason = False, f"{error.strerror} ({file}: {text})"
        if not is_limited and not text.startswith("max"):
            raise DoraSystemdError(
                f"cannot limit the node {limits.node}: {reason}",
                "the kernel or the container does not provide it to this dataflow",
                ExitCode.NO_SYSTEMD,
            )


def read_files(path: Path, names: Iterable[str]) -> dict[str, str]:
    """The texts of control files of a group, for restore_group."""
    return {name: read_text(path / name) for name in names}


def restore_group(path: Path, texts: Mapping[str, str]) -> None:
    """Write back what read_files has read, as far as the kernel lets us."""
    for name, text in texts.items():
        with contextlib.suppress(OSError):
            _write(path / name, text.strip())


def move_process(path: Path, pid: int) -> None:
    """Move process `pid` (0: this one) into the group. Raises OSError."""
    control = os.open(path / "cgroup.procs", os.O_WRONLY | os.O_CLOEXEC)
    try:
        os.write(control, str(pid).encode())
    finally:
        os.close(control)


def kill_group(path: Path) -> None:
    """SIGKILL to everything in the group and below it at once; nothing can fork away.

    cgroup.kill exists since Linux 5.14; before, every process gets its signal by pid.
    """
    if not _write(path / "cgroup.kill", "1"):
        for pid in pids(path):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, 9)


def freeze_group(path: Path, is_frozen: bool) -> bool:
    """Stop every process of the group, or let them go on; whether the kernel was told.

    SIGKILL ends what is frozen; other signals wait until it goes on. cgroup.freeze in the kernel's
    document, since Linux 5.2.
    """
    with contextlib.suppress(OSError):
        return _write(path / "cgroup.freeze", str(int(is_frozen)))
    return False


def _tree(path: Path) -> Iterator[Path]:
    """The group and all below it; no recursion, as the nodes' user can nest them very deeply."""
    left = deque([path])
    while left:
        yield (group := left.popleft())
        with contextlib.suppress(OSError), os.scandir(group) as entries:
            left.extend(Path(one.path) for one in entries if one.is_dir(follow_symlinks=False))


def _write(path: Path, text: str) -> bool:
    """Write to a control file; False where the kernel has no such file or controller."""
    try:
        control = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
        try:
            os.write(control, text.encode())
        finally:
            os.close(control)
    except OSError as error:
        if error.errno in _ABSENT:
            return False
        raise
    return True


def read_text(path: Path) -> str:
    """The text of a control file; "" where there is none, or no group any more."""
    # A group may vanish between any two looks at it: that is the same as an empty one.
    # There are many of them, and a text file's machinery takes longer than the kernel does.
    with contextlib.suppress(OSError), io.FileIO(path) as file:
        return file.readall().decode()
    return ""


def read_number(path: Path) -> int | None:
    """The number in a control file, INFINITY for "max", None where there is none."""
    text = read_text(path).strip()
    if not text:
        return None
    return INFINITY if text == "max" else int(text)


def _read_share(path: Path) -> int | None:
    """cpu.max as µs per second."""
    quota, _, period = read_text(path).strip().partition(" ")
    if not period:
        return None
    return INFINITY if quota == "max" else int(quota) * SECOND // int(period)


def _resident_bytes(pid: int) -> int:
    """The second number of /proc/PID/statm, see proc_pid_statm(5); in pages there."""
    numbers = read_text(Path(f"/proc/{pid}/statm")).split()
    return int(numbers[1]) * os.sysconf("SC_PAGE_SIZE") if len(numbers) > 1 else 0

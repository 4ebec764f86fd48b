"""The cgroup tree: reads its numbers, and changes the part that is delegated to the runner.

The source is the kernel's "Control Group v2" document. A group has the name that systemd and
/proc/PID/cgroup use: its path from the root of the hierarchy, "/dora.slice/dora-x.service".
"""

import contextlib
import errno
import io
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import islice
from pathlib import Path
from signal import SIGKILL, Signals, pidfd_send_signal

from dora_systemd.decisions.cell.extra import EXTRA
from dora_systemd.decisions.resources.usage import Usage
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import UNIT_SUFFIX, is_node_id
from dora_systemd.values import INFINITY, SECOND

NODE_PREFIX = "node-"
CPUSET = "cpuset"
"""The controller that keeps processes on some CPUs."""
CPUS_FILE = f"{CPUSET}.cpus"
SUPERVISOR = "supervisor"
"""The group of the runner and of dora's own processes, below that of the unit."""
MAX_GROUPS = 300
"""Maximum groups to read if their names are not known: the nodes' user can create any number."""
MAX_PROCESSES = 5000
"""Maximum processes to count one by one without a memory controller."""
_MAX_ENTRIES = 10_000
_CHUNK = 1 << 14
_MOST_FORKS = 100
_SHORT = 2048
"""Bytes of a read of a control file that is the last one: if more is to come, the kernel returns
nearly a page, and a line is shorter than the rest of it."""
_CHILDLESS = 2
"""Links of a directory without directories in it, which cgroup2 counts; see inode(7)."""
MOUNTS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified"))

_ABSENT = (errno.ENOENT, errno.ENODEV, errno.EOPNOTSUPP, errno.ENOTSUP)


@cache
def mount_point(places: tuple[Path, ...] = MOUNTS) -> Path:
    """The mount point of the cgroup2 hierarchy; on hybrid systems it is one level deeper.

    Raises DoraSystemdError (NO_SYSTEMD) if there is none.
    """
    for place in places:
        if (place / "cgroup.procs").exists():
            return place
    raise DoraSystemdError(
        "cannot find the cgroup v2 hierarchy below /sys/fs/cgroup",
        "boot with systemd.unified_cgroup_hierarchy=1 on the command line of the kernel",
        ExitCode.NO_SYSTEMD,
    )


def group_path(group: str) -> Path:
    """The directory of `group`, which is like "/a/b", as in systemd's ControlGroup= property."""
    return mount_point() / group.lstrip("/")


def group_of(process: int | str = "self") -> str:
    """The group of a process, or "/" if it has exited: "0::" in /proc/PID/cgroup, cgroups(7)."""
    # Not by splitlines(): a name can contain other ends of a line.
    for line in read_text(f"/proc/{process}/cgroup").split("\n"):
        if line.startswith("0::"):
            return line[3:]
    return "/"


def has_group(path: Path) -> bool:
    """Whether the group exists."""
    return os.path.isdir(path)  # noqa: PTH112 - a Path takes longer


def maker_of(path: Path) -> int | None:
    """The uid that owns the parent of a group, and so can make groups there; None without it."""
    with contextlib.suppress(OSError):
        return path.parent.stat().st_uid
    return None


def node_groups(path: Path) -> dict[str, Path]:
    """Directories of the node groups below a unit's `path`, by node id."""
    return _by_node(path, sorted(one for one in _names(path) if one.startswith(NODE_PREFIX)))


def shown_groups(path: Path, nodes: Iterable[str] = ()) -> dict[str, Path]:
    """The existing groups of `nodes`, or up to MAX_GROUPS groups that may be nodes', but for EXTRA.

    For readers outside the cell: the nodes' user can create groups of any name and number.
    """
    if names := [f"{NODE_PREFIX}{node}" for node in nodes]:
        return _by_node(path, names)
    found = filter(_is_node_group, islice(_names(path), _MAX_ENTRIES))
    return _by_node(path, sorted(found)[:MAX_GROUPS])


def count_units(slice_name: str, besides: str) -> int:
    """Count the services in a top-level slice of the system manager, without the one `besides`."""
    names = _names(group_path(f"/{slice_name}"))
    return sum(one.endswith(UNIT_SUFFIX) and one != besides for one in names)


def _names(path: Path) -> Iterator[str]:
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        yield from (one.name for one in entries)


def _by_node(path: Path, names: Iterable[str]) -> dict[str, Path]:
    groups = (path / name for name in names)
    with contextlib.suppress(OSError):
        return {one.name.removeprefix(NODE_PREFIX): one for one in groups if one.is_dir()}
    return {}


def _is_node_group(name: str) -> bool:
    node = name.removeprefix(NODE_PREFIX)
    return node != name and is_node_id(node) and node not in EXTRA


def read_usage(path: Path) -> Usage:
    """CPU and memory of a group and all groups below it; zero if it no longer exists.

    Without a memory controller, memory is the sum of the processes' resident sets.
    """
    return read_present(path)._replace(memory_peak=read_number(f"{path}/memory.peak"))


def read_present(path: Path) -> Usage:
    """Read what read_usage() does, but the peak, which many readers do not need."""
    # Texts for paths, here and below: a Path takes longer than the kernel does for a file.
    memory = read_number(f"{path}/memory.current")
    if memory is None:
        memory = sum(map(_resident_bytes, some_pids(path)))
    return read_cpu(path)._replace(
        memory=memory,
        memory_max=read_number(f"{path}/memory.max"),
        cpu_max=_read_share(f"{path}/cpu.max"),
    )


def read_cpu(path: Path) -> Usage:
    """CPU time and throttling of a group; exists even without a cpu controller."""
    numbers = read_numbers(f"{path}/cpu.stat")
    throttling = numbers.get("nr_periods", 0), numbers.get("nr_throttled", 0)
    return Usage(numbers.get("usage_usec", 0), throttling=throttling)


def read_numbers(path: str | Path) -> dict[str, int]:
    """The numbers of a control file with lines KEY NUMBER; {} if it does not exist."""
    pairs = (line.partition(" ") for line in read_text(path).splitlines())
    return {key: int(value) for key, _, value in pairs}


def pids(path: Path) -> list[int]:
    """The processes of a group and of all groups below it."""
    return list(_pids(_tree(path)))


def some_pids(path: Path) -> list[int]:
    """Up to MAX_PROCESSES processes of up to MAX_GROUPS groups, for readers outside the cell."""
    return list(islice(_pids(islice(_tree(path), MAX_GROUPS)), MAX_PROCESSES))


def _pids(groups: Iterable[str]) -> Iterator[int]:
    return (int(pid) for one in groups for pid in read_text(f"{one}/cgroup.procs").split())


def is_populated(path: Path) -> bool:
    """Whether the group or one below it has a process."""
    return "populated 1" in read_text(f"{path}/cgroup.events").splitlines()


def is_frozen(path: Path) -> bool:
    """Whether all processes of the group and of those below it are frozen, by it or from above."""
    return "frozen 1" in read_text(f"{path}/cgroup.events").splitlines()


def make_group(path: Path) -> None:
    """Create one group unless it exists. Raises OSError."""
    path.mkdir(exist_ok=True)


def remove_group(path: Path) -> None:
    """Remove a group without processes; ignore one that is busy or missing."""
    with contextlib.suppress(OSError):
        path.rmdir()


def read_controllers(path: Path) -> frozenset[str]:
    """The controllers of a group, which it can enable for groups below it."""
    return frozenset(read_text(path / "cgroup.controllers").split())


def read_tasks(path: Path) -> tuple[int | None, int | None]:
    """The processes and threads of a group, and its limit of them; None without a controller."""
    return read_number(f"{path}/pids.current"), read_number(f"{path}/pids.max")


def read_cpus(path: Path) -> str:
    """The CPUs that a group itself is bound to, "" if to none."""
    return read_text(path / CPUS_FILE).strip()


def enable_controllers(path: Path) -> None:
    """Enable every controller of `path` for the groups below it.

    Ignores what the kernel does not offer: some containers have no controllers at all.
    """
    for name in sorted(read_controllers(path)):
        write_text(path / "cgroup.subtree_control", f"+{name}")


def kill_as_one(path: Path) -> None:
    """Have the kernel's OOM killer kill all processes of the group together: memory.oom.group."""
    write_text(path / "memory.oom.group", "1")


def move_process(path: Path, pid: int) -> None:
    """Move process `pid` (0: this one) into the group. Raises OSError."""
    _put(path / "cgroup.procs", str(pid))


def kill_group(path: Path) -> None:
    """Kill everything in the group and below it at once, so that no process can fork away.

    cgroup.kill exists since Linux 5.14; on older kernels each process gets a signal by its pid.
    """
    if not write_text(path / "cgroup.kill", "1"):
        for pid in pids(path):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, 9)


def freeze_group(path: Path, is_frozen: bool) -> bool:
    """Freeze or thaw every process of the group; whether the kernel accepted that.

    SIGKILL ends frozen processes; other signals wait until they are thawed. cgroup.freeze exists
    since Linux 5.2.
    """
    with contextlib.suppress(OSError):
        return write_text(path / "cgroup.freeze", str(int(is_frozen)))
    return False


def _tree(path: Path) -> Iterator[str]:
    """The group and all groups below it; not recursive, as users can nest them deeply."""
    left = deque([str(path)])
    while left:
        yield (group := left.popleft())
        with contextlib.suppress(OSError):
            # Most have none, and a list of the control files takes longer than all else.
            if os.stat(group).st_nlink != _CHILDLESS:  # noqa: PTH116 - a Path takes longer
                left.extend(_groups_in(group))


def _groups_in(group: str) -> list[str]:
    with os.scandir(group) as entries:
        return [one.path for one in entries if one.is_dir(follow_symlinks=False)]


def write_text(path: Path, text: str) -> bool:
    """Write to a control file; False if the kernel has no such file. Raises OSError."""
    try:
        _put(path, text)
    except OSError as error:
        if error.errno in _ABSENT:
            return False
        raise
    return True


def _put(path: Path, text: str) -> None:
    # Without O_CREAT, which a mode of FileIO would add: it hides that the file does not exist.
    with io.FileIO(os.open(path, os.O_WRONLY | os.O_CLOEXEC), "w") as control:
        try:
            control.write(text.encode())
        except OSError as error:
            error.filename = str(path)  # the kernel refuses by a number alone
            raise


def read_text(path: str | Path) -> str:
    """The text of a control file; "" if the file or the group does not exist."""
    # A group can disappear at any moment, which counts as empty. Not by open(): there are many of
    # these files, and Python's file objects take longer than the kernel.
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return ""
    try:
        data = part = os.read(fd, _CHUNK)
        while len(part) > _SHORT:
            part = os.read(fd, _CHUNK)
            data += part
    except OSError:
        return ""
    finally:
        os.close(fd)
    return os.fsdecode(data)  # a name need not be UTF-8


def read_number(path: str | Path) -> int | None:
    """The number in a control file, INFINITY for "max", None where there is none."""
    text = read_text(path).strip()
    if not text:
        return None
    return INFINITY if text == "max" else int(text)


def _read_share(path: str | Path) -> int | None:
    """The quota of cpu.max as µs per second."""
    quota, _, period = read_text(path).strip().partition(" ")
    if not period:
        return None
    return INFINITY if quota == "max" else int(quota) * SECOND // int(period)


def _resident_bytes(pid: int) -> int:
    """The resident set in bytes: the second number of /proc/PID/statm, see proc_pid_statm(5)."""
    numbers = read_text(f"/proc/{pid}/statm").split()
    return int(numbers[1]) * os.sysconf("SC_PAGE_SIZE") if len(numbers) > 1 else 0


def is_member(path: Path, pid: int, find: Callable[[int], str] = group_of) -> bool:
    """Whether the process is in the group at `path`, or in one below it. find: gives its group."""
    return group_path(find(pid)).is_relative_to(path)


def signal_group(
    path: Path, number: Signals, first: int, is_in: Callable[[Path, int], bool] = is_member
) -> None:
    """Send a signal to all processes of the group and below it, to process `first` before others.

    is_in: whether a process is in a group.
    """
    signal_processes(path, number, sorted(pids(path), key=lambda pid: pid != first), is_in)


def signal_processes(
    path: Path,
    number: Signals,
    some: Iterable[int],
    is_in: Callable[[Path, int], bool] = is_member,
) -> bool:
    """Send a signal to some processes of the group and below it, in this order.

    A process that leaves the group meanwhile, or takes over a pid, gets none. Return whether none
    of them is another user's, to whom this process may send no signal. is_in: as above.
    """
    is_ours = True
    for pid in some:
        with contextlib.suppress(OSError):
            pidfd = os.pidfd_open(pid)
            try:
                if is_in(path, pid):
                    pidfd_send_signal(pidfd, number)
            except PermissionError:
                is_ours = False
            finally:
                os.close(pidfd)
    return is_ours


def kill_left(
    path: Path, is_old: Callable[[], bool], is_in: Callable[[Path, int], bool] = is_member
) -> None:
    """Kill what an ended process has left in the group and below it, and no process that enters it.

    is_old: whether nothing has entered the group until now. cgroup.kill would also end what enters
    just now, so it is only for what forks faster than it is killed, and for programs that have
    another user's rights (setuid). is_in: as above.
    """
    killed = set[int]()
    for _ in range(_MOST_FORKS):
        left = [one for one in pids(path) if one not in killed]
        if not left or not is_old():
            return
        if not signal_processes(path, SIGKILL, left, is_in):
            break
        killed.update(left)
    kill_group(path)


def find_groups(is_wanted: Callable[[str], object], most: int) -> list[str]:
    """The groups of the whole hierarchy with such a name, among the first `most` groups."""
    top = mount_point()
    every = islice(_tree(top), most)
    return [f"/{Path(one).relative_to(top)}" for one in every if is_wanted(one.rpartition("/")[2])]

"""The processes of a group: whether one belongs to it, and signals to all of them."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from signal import Signals, pidfd_send_signal

from dora_systemd.adapters.cgroup.groups import group_of, group_path, pids


def is_member(path: Path, pid: int, find: Callable[[int], str] = group_of) -> bool:
    """Whether the process is in the group at `path`, or in one below it. find: gives its group."""
    return group_path(find(pid)).is_relative_to(path)


def signal_group(
    path: Path, number: Signals, first: int, is_in: Callable[[Path, int], bool] = is_member
) -> None:
    """Send a signal to all processes of the group and below it, to process `first` before others.

    A process that leaves the group meanwhile, or takes over a pid, gets none. is_in: whether a
    process is in a group.
    """
    for pid in sorted(pids(path), key=lambda pid: pid != first):
        with contextlib.suppress(OSError):
            pidfd = os.pidfd_open(pid)
            try:
                if is_in(path, pid):
                    pidfd_send_signal(pidfd, number)
            finally:
                os.close(pidfd)

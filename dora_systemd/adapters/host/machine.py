"""The size of this machine, from proc(5)."""

import os
from pathlib import Path

from dora_systemd.decisions.settings.limit_checks import Machine
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import cpu_numbers, parse_cpus

_KIB = 1024
_ONLINE = Path("/sys/devices/system/cpu/online")


def read_machine() -> Machine:
    """Bytes of memory, number of processors and maximum tasks. Raises OSError without /proc."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    total = next(int(line.split()[1]) for line in lines if line.startswith("MemTotal:"))
    tasks = int(Path("/proc/sys/kernel/pid_max").read_text())
    return Machine(total * _KIB, os.cpu_count() or 1, tasks, _online())


def _online() -> frozenset[int] | None:
    """The online CPUs, see sysfs's cpu/online in the kernel's cputopology document."""
    try:
        return frozenset(cpu_numbers(parse_cpus(_ONLINE.read_text())))
    except (OSError, DoraSystemdError):
        return None

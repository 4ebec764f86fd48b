"""What all processes of this machine use: its CPUs, its memory and its disks. Pure."""

import re
from typing import NamedTuple

_KIB = 1024
_MEMORY = re.compile(r"^(MemTotal|MemAvailable):\s*([0-9]+) kB$", re.M)
_IDLE, _ALL = slice(3, 5), slice(0, 8)
"""Numbers of a CPU in /proc/stat, see proc_stat(5): idle and iowait, and those up to steal."""


class Disk(NamedTuple):
    """A file system. path: a directory on it."""

    path: str
    size: int  # bytes
    free: int  # for users


class HostUse(NamedTuple):
    """The usage of the machine. None: unknown."""

    # ticks of all CPUs since the boot
    busy: int | None = None
    ticks: int | None = None
    cpus: int = 1
    memory: int | None = None
    available: int | None = None
    disk: Disk | None = None  # the fullest one

    def values(self) -> dict[str, int | str | None]:
        """The usage for the page, which makes a share of two numbers of ticks."""
        return {
            "busy_ticks": self.busy,
            "ticks": self.ticks,
            "cpus": self.cpus,
            "memory_bytes": self.memory,
            "memory_available_bytes": self.available,
            "disk": self.disk.path if self.disk else None,
            "disk_bytes": self.disk.size if self.disk else None,
            "disk_free_bytes": self.disk.free if self.disk else None,
        }


def parse_ticks(stat: str) -> tuple[int | None, int | None]:
    """The ticks in which the CPUs were busy, and all of them, in the text of /proc/stat."""
    word, *rest = stat.partition("\n")[0].split()[:9] or [""]
    numbers = [int(one) for one in rest if one.isdecimal()]
    if word != "cpu" or len(numbers) < len(rest) or len(numbers) <= _IDLE.start:
        return None, None
    every = sum(numbers[_ALL])
    return every - sum(numbers[_IDLE]), every


def parse_memory(meminfo: str) -> tuple[int | None, int | None]:
    """Bytes of memory, and those that programs can still get, in the text of /proc/meminfo."""
    found = {name: int(kib) * _KIB for name, kib in _MEMORY.findall(meminfo)}
    return found.get("MemTotal"), found.get("MemAvailable")


def fullest(disks: list[Disk]) -> Disk | None:
    """The disk with the smallest share free; None of none."""
    return min(disks, key=lambda one: one.free / one.size, default=None)

"""What this machine offers for real time: its kernel, its CPUs, and whether root may have it."""

import contextlib
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.views.findings import RealTime
from dora_systemd.errors import DoraSystemdError

_CPUS = "sys/devices/system/cpu"
_CONFIGS = ("proc/config.gz", f"boot/config-{os.uname().release}")
_OPTION = "CONFIG_RT_GROUP_SCHED"
_AT_BOOT = r"\brt_group_sched=([01])\b"
_CONTROLLERS = "sys/fs/cgroup/cgroup.controllers"
_BOUNDING = re.compile(r"^CapBnd:\s*([0-9a-f]+)$", re.M)
_CAP_SYS_RESOURCE = 1 << 24
_MOST_BYTES = 4 * 1024 * 1024
_GZIP = 16 + zlib.MAX_WBITS
_SECONDS = 10.0
_REALTIME = ("usr/bin/chrt", "--fifo", "1", "/bin/true")
_LIMIT = ("usr/bin/prlimit", "--rtprio=99:99", "/bin/true")


def read_real_time(root: Path = Path("/")) -> RealTime:
    """All facts. As root it tries to get rights, in children that end at once.

    root: the directory with all files of the machine.
    """
    return RealTime(
        has_groups=_has_groups(root),
        is_granted=_can_run(root, _REALTIME),
        can_raise=_can_raise(root),
        isolated=_text(root / _CPUS / "isolated"),
        governors=_governors(root / _CPUS),
    )


def _has_groups(root: Path) -> bool | None:
    """Whether groups with the cpu controller on have no realtime, see sched-rt-group of Linux."""
    lines = next(filter(None, (_config(root / one) for one in _CONFIGS)), "").splitlines()
    if not lines:
        return None
    said = re.findall(_AT_BOOT, _text(root / "proc/cmdline"))
    is_on = said[-1] == "1" if said else f"{_OPTION}_DEFAULT_DISABLED=y" not in lines
    controllers = root / _CONTROLLERS
    is_used = not controllers.exists() or "cpu" in _text(controllers).split()
    return f"{_OPTION}=y" in lines and is_on and is_used


def _can_raise(root: Path) -> bool | None:
    """Whether PID 1 could raise limits: what it may not, no service gets. None: not known."""
    bounding = _BOUNDING.search(_text(root / "proc/1/status"))
    if bounding and not int(bounding[1], 16) & _CAP_SYS_RESOURCE:
        return False
    return _can_run(root, _LIMIT)


def _config(path: Path) -> str:
    """The configuration of the kernel, compressed or not; "" if it is not there."""
    with contextlib.suppress(OSError, zlib.error), path.open("rb") as file:
        data = file.read(_MOST_BYTES)
        is_packed = path.suffix == ".gz"
        plain = zlib.decompressobj(_GZIP).decompress(data, _MOST_BYTES) if is_packed else data
        return plain.decode(errors="replace")
    return ""


def _can_run(root: Path, command: Sequence[str]) -> bool | None:
    """Whether root can; None for others, and if the program is not there."""
    if os.geteuid() != 0:
        return None
    try:
        return run_command([str(root / command[0]), *command[1:]], _SECONDS).status == 0
    except DoraSystemdError:
        return None


def _governors(cpus: Path) -> tuple[str, ...]:
    found = {_text(path) for path in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    return tuple(sorted(filter(None, found)))


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text().strip()
    return ""

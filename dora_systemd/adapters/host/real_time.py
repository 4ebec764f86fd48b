"""What this machine offers for real time: its kernel, its CPUs, and whether root may have it."""

import contextlib
import os
import zlib
from pathlib import Path

from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.views.real_time import RealTime
from dora_systemd.errors import DoraSystemdError

_CPUS = Path("/sys/devices/system/cpu")
_CONFIGS = ("/proc/config.gz", f"/boot/config-{os.uname().release}")
_OPTION = "CONFIG_RT_GROUP_SCHED"
_MOST_BYTES = 4 * 1024 * 1024
_GZIP = 16 + zlib.MAX_WBITS
_SECONDS = 10.0
_TRY = ("/usr/bin/prlimit", "--rtprio=1:1", "/usr/bin/chrt", "--fifo", "1", "/bin/true")


def read_real_time() -> RealTime:
    """All facts. As root it tries to get a realtime priority, in a child that ends at once."""
    return RealTime(_has_groups(), _is_granted(), _text(_CPUS / "isolated"), _governors())


def _has_groups() -> bool | None:
    lines = next(filter(None, map(_config, _CONFIGS)), "").splitlines()
    return f"{_OPTION}=y" in lines if lines else None


def _config(path: str) -> str:
    """The configuration of the kernel, compressed or not; "" if it is not there."""
    with contextlib.suppress(OSError, zlib.error), Path(path).open("rb") as file:
        data = file.read(_MOST_BYTES)
        plain = zlib.decompressobj(_GZIP).decompress(data, _MOST_BYTES) if "gz" in path else data
        return plain.decode(errors="replace")
    return ""


def _is_granted() -> bool | None:
    if os.geteuid() != 0:
        return None
    try:
        return run_command(_TRY, _SECONDS).status == 0
    except DoraSystemdError:
        return None


def _governors() -> tuple[str, ...]:
    found = {_text(path) for path in _CPUS.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    return tuple(sorted(filter(None, found)))


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text().strip()
    return ""

"""How slow this machine is just now: bounds of tests are in seconds of an idle machine.

An emulated processor is ten times slower than the host's, a kernel in user mode four times, a busy
host two to five times slower than an idle one. A test says how long a thing may take where nothing
is in its way; how much longer that is here is measured here, and nowhere else.
"""

import subprocess
import sys
import time

REFERENCE_SECONDS = 0.012
"""What the work below takes on an idle machine with two cores, natively."""

SLOWEST = 60.0
"""An emulated machine on a busy host. A bound that grows for ever is none."""

_SAMPLES = 5
_FRESH_SECONDS = 30.0
_WORK = [sys.executable, "-I", "-S", "-c", "for _ in range(10000): pass"]

_last: tuple[float, float] | None = None


def measure() -> float:
    """How many times longer than on an idle machine a process takes now; at least 1."""
    begun = time.monotonic()
    for _ in range(_SAMPLES):
        subprocess.run(_WORK, check=True)
    taken = (time.monotonic() - begun) / _SAMPLES
    return min(max(1.0, taken / REFERENCE_SECONDS), SLOWEST)


def pace() -> float:
    """The same, measured at most every half minute."""
    global _last
    if _last is None or time.monotonic() - _last[0] > _FRESH_SECONDS:
        factor = measure()
        _last = time.monotonic(), factor
    return _last[1]


def bound(seconds: float) -> float:
    """The seconds that this machine may take for what an idle one does in `seconds`."""
    return seconds * pace()

"""How much of the host a machine gets: an emulator, or a kernel in user mode.

LAB_SPEED=50 gives it half of its time: a slow machine, to try the tests on.
"""

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lab.errors import LabError

PERIOD_SECONDS = 0.02
FULL_SPEED = 100
# One process does what a hundred do in a container, and each session there has a share of its own.
GROUP_NICE = -3


def read_speed(text: str | None) -> int:
    """Percent of the time that the machine runs. Raises LabError."""
    speed = int(text) if text and text.isdecimal() else 0 if text else FULL_SPEED
    if not 1 <= speed <= FULL_SPEED:
        raise LabError(f"use LAB_SPEED={text}", "percent, 1 to 100")
    return speed


@contextmanager
def slowed(process: subprocess.Popen[bytes], speed: int) -> Iterator[None]:
    """Stop `process` and let it go on, over and over again; at full speed, prefer its session."""
    is_over = threading.Event()
    thread = threading.Thread(
        target=_alternate, args=(process, speed / FULL_SPEED, is_over), daemon=True
    )
    if speed < FULL_SPEED:
        thread.start()
    else:
        prefer(process.pid)
    try:
        yield
    finally:
        is_over.set()
        if speed < FULL_SPEED:
            thread.join()


def prefer(pid: int) -> None:
    """Give the session of `pid` more time than others, see sched(7), "The autogroup feature".

    Does nothing where the kernel groups by cgroup only.
    """
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(GROUP_NICE), encoding="ascii")


def _alternate(process: subprocess.Popen[bytes], share: float, is_over: threading.Event) -> None:
    with suppress(ProcessLookupError):
        while not is_over.wait(PERIOD_SECONDS * share) and process.poll() is None:
            os.kill(process.pid, signal.SIGSTOP)
            is_over.wait(PERIOD_SECONDS * (1 - share))
            os.kill(process.pid, signal.SIGCONT)

"""One directory and one cgroup per run; those of killed runs are found by their free lock."""

import fcntl
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from lab.cache import find_cache, take_lock, try_lock
from lab.errors import LabError
from lab.pace import bound
from lab.process import read_last_line

RUNS = Path("/run/dora-systemd-lab")
CONSOLE = "console"
"""The file of a run with what a machine prints on its console."""
LOG = "log"
"""The file of a run with what the machine's emulator prints."""


@dataclass(frozen=True)
class Run:
    directory: Path
    lock: int

    @property
    def name(self) -> str:
        return self.directory.name


@contextmanager
def opened_door() -> Iterator[None]:
    """One at a time, or a new directory without its lock yet would look like a dead one."""
    RUNS.mkdir(mode=0o700, exist_ok=True)
    door = take_lock(RUNS / ".lock", fcntl.LOCK_EX)
    try:
        yield
    finally:
        os.close(door)


def open_run() -> Run:
    with opened_door():
        clean_dead_runs()
        directory = RUNS / f"lab-{secrets.token_hex(4)}"
        directory.mkdir(mode=0o700)
        return Run(directory, take_lock(directory / "lock", fcntl.LOCK_EX))


def with_console(error: LabError, run: Run) -> LabError:
    """The error of a machine, with the last words of its emulator, if it has said any.

    What the machine has said on its console is kept beside the images.
    """
    kept = find_cache() / "console.log"
    with suppress(FileNotFoundError):
        shutil.copy(run.directory / CONSOLE, kept)
    log = run.directory / LOG
    last = read_last_line(log) if log.exists() else ""
    said = f": {last}" if last not in error.message else ""
    return LabError(f"{error.message}{said}", error.hint or f"see {kept}")


class Guard:
    """Outlives a kill -9 of the lab and cleans up after it at once."""

    def __enter__(self) -> None:
        sweep = [sys.executable, sys.argv[0], "sweep"]
        self.waiter = subprocess.Popen(
            ["sh", "-c", 'read -r done || exec "$@"', "lab-guard", *sweep],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def __exit__(self, *_: object) -> None:
        self.waiter.communicate(b"done\n")


def clean_dead_runs() -> None:
    for directory in RUNS.glob("lab-*"):
        with suppress(FileNotFoundError):  # gone since we looked
            lock = try_lock(directory / "lock")
            if lock is not None:
                close_run(Run(directory, lock))
    for directory in RUNS.glob("gone-*"):
        shutil.rmtree(directory, ignore_errors=True)


def close_run(run: Run) -> None:
    for kind, remove in (("cgroup", remove_cgroup), ("disk", remove_disk)):
        for path in read_noted(run, kind):
            remove(path)
    # Without its lock file, which goes at some time, another lab would take it for a dead run.
    gone = run.directory.rename(RUNS / f"gone-{run.name}")
    shutil.rmtree(gone, ignore_errors=True)
    os.close(run.lock)


def note(run: Run, kind: str, path: Path) -> None:
    """Written before the thing is made, so that whoever cleans up knows of it."""
    with (run.directory / kind).open("a", encoding="utf-8") as file:
        file.write(f"{path}\n")


def read_noted(run: Run, kind: str) -> list[Path]:
    file = run.directory / kind
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [Path(line) for line in lines]


def remove_disk(path: Path) -> None:
    path.unlink(missing_ok=True)


def remove_cgroup(path: Path, patience: float = 20) -> None:
    deadline = time.monotonic() + bound(patience)
    while path.exists():
        if time.monotonic() > deadline:
            raise LabError(f"end the processes in {path}", "do they hang in the kernel?")
        # Busy until the last has died; and a systemd on the host removes some of it before us.
        with suppress(OSError):
            (path / "cgroup.kill").write_text("1", encoding="ascii")
            remove_empty(path)
        time.sleep(0.005)


def remove_empty(path: Path) -> None:
    """Deepest first; the kernel's own files in them do not count."""
    for directory, _, _ in os.walk(path, topdown=False):
        Path(directory).rmdir()

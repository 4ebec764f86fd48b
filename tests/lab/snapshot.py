"""LAB=emulator: Debian's own kernel, emulated; booted once, and every run resumed from there."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lab import definition, qemu
from lab.cache import Layer, ensure, find_cache
from lab.disk import NAME, disk_layer, kernel_layer
from lab.emulator import emulator_layer, program
from lab.errors import LabError, Stage
from lab.guest import Guest
from lab.initrd import write_initrd
from lab.pace import bound
from lab.process import need_tools, run_logged
from lab.runs import Run, close_run, note, open_run, with_console
from lab.slow import FULL_SPEED, read_speed

SNAPSHOT = "booted"
MEMORY = "2G"
BOOT_SECONDS = 180.0

SOURCES = ("snapshot.py", "qemu.py", "emulator.py", "initrd.py")

# Once before the snapshot, so that no run pays for reading them from disk.
WARM_UP = (
    "import dora, pyarrow, pydantic, click, yaml, websockets, watchfiles, pytest;"
    "import pystemd, systemd.journal, hypothesis"
)


def ensure_snapshot(cache: Path) -> Path:
    need_tools("mmdebstrap", "mke2fs")
    ensure(cache, emulator_layer(cache))
    disk = disk_layer(cache)
    ensure(cache, disk)
    sources = [definition.read_part(definition.HERE / name) for name in SOURCES]
    key = definition.digest(disk.key, emulator_layer(cache).key, sources)
    return ensure(cache, Layer("snapshot", key, lambda path: build_snapshot(path, cache)))


def find_emulator() -> Path:
    """It is there, and held, once the machine has been asked for."""
    cache = find_cache()
    return cache / emulator_layer(cache).name


def build_snapshot(path: Path, cache: Path) -> None:
    kernel = ensure(cache, kernel_layer(cache))
    disk = ensure(cache, disk_layer(cache))
    shutil.copy(next(kernel.glob("boot/vmlinuz-*")), path / "vmlinuz")
    write_initrd(kernel, path / "initrd")
    with Stage("first boot and snapshot of the emulated machine"):
        write_snapshot(path, disk, cache / "snapshot.log")


def write_snapshot(path: Path, below: Path, log: Path) -> None:
    disk = path / "booted.qcow2"
    # A relative name: both directories are in the cache, which may be moved.
    base = f"../{below.name}/{NAME}"
    create = ["create", "-q", "-f", "qcow2", "-F", "raw", "-b", base, str(disk)]
    run_logged([*program(find_emulator(), "qemu-img"), *create], log, "make the snapshot's disk")
    run = open_run()
    try:
        with started_emulator(run, path, disk) as guest:
            guest.wait_boot(bound(BOOT_SECONDS))
            warm_up(guest)
            qemu.ask_monitor(run.directory, f"savevm {SNAPSHOT}")
    finally:
        close_run(run)


@contextmanager
def started_emulator(run: Run, layer: Path, disk: Path, snapshot: str = "") -> Iterator[Guest]:
    command = qemu.machine_command(find_emulator(), layer, disk, run.directory, snapshot, MEMORY)
    # An image is built as quickly as can be.
    speed = read_speed(os.environ.get("LAB_SPEED")) if snapshot else FULL_SPEED
    try:
        with qemu.started(command, run.directory, speed) as port:
            yield Guest(port)
    except LabError as error:
        raise with_console(error, run) from None


def warm_up(guest: Guest) -> None:
    for step in warm_up_commands():
        if guest.run_quietly(step):
            raise LabError(f"run {' '.join(step)} in the machine")


def warm_up_commands() -> list[list[str]]:
    return [
        ["depmod"],
        ["/bin/sh", "-c", "systemctl is-system-running --wait >/dev/null"],
        ["/opt/lab/bin/python", "-c", WARM_UP],
        ["/bin/sh", "-c", "/opt/lab/bin/dora --version >/dev/null"],
        ["systemd-run", "--quiet", "--wait", "--pipe", "git", "--version"],
        ["/bin/sync"],
    ]


@contextmanager
def resumed(run: Run, layer: Path) -> Iterator[Guest]:
    disk = layer / f"{run.name}.qcow2"
    note(run, "disk", disk)
    copy = ["cp", "--reflink=auto", "--sparse=auto", str(layer / "booted.qcow2"), str(disk)]
    subprocess.run(copy, check=True)
    with started_emulator(run, layer, disk, SNAPSHOT) as guest:
        yield guest

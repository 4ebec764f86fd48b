"""LAB=vm: the tree as a disk, booted once, and every run resumed from there."""

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from lab import definition, emulator, qemu
from lab.bytecode import ensure_bytecode
from lab.cache import Layer, ensure, ensure_locked, find_cache
from lab.emulator import emulator_layer, program
from lab.errors import LabError, Stage
from lab.guest import Guest, write_all, write_err, write_out
from lab.image import (
    DIFFERENCE,
    base_layer,
    check_packed,
    debian_command,
    ensure_tree,
    pack_command,
)
from lab.initrd import write_initrd
from lab.options import Options
from lab.pace import bound
from lab.process import need_tools, run_logged
from lab.runs import Run, close_run, note, open_run
from lab.service import service_command
from lab.slow import FULL_SPEED, read_speed
from lab.terminal import is_terminal, kept_terminal

SNAPSHOT = "booted"
MEMORY = "2G"
DISK = "6G"
BOOT_SECONDS = 180.0

SOURCES = ("machine.py", "qemu.py", "emulator.py", "agent.py", "wire.py", "initrd.py")

AGENT_UNIT = """\
[Unit]
Description=Runs the commands of the lab
[Service]
ExecStart=/usr/bin/python3 -m lab.agent
WorkingDirectory=/usr/local/lib
Restart=always
OOMScoreAdjust=-1000
"""

# Once before the snapshot, so that no run pays for reading them from disk.
WARM_UP = (
    "import dora, pyarrow, numpy, pydantic, click, yaml, websockets, watchfiles, pytest;"
    "import pystemd, systemd.journal, hypothesis"
)


def ensure_machine(cache: Path) -> Path:
    need_tools("mmdebstrap", "mke2fs")
    ensure(cache, emulator_layer(cache))
    sources = [definition.read_part(definition.HERE / name) for name in SOURCES]
    key = definition.digest(definition.base_key(), kernel_key(), emulator.key(), sources)
    return ensure(cache, Layer("machine", key, lambda path: build_machine(path, cache)))


def find_emulator() -> Path:
    """It is there, and held, once the machine has been asked for."""
    cache = find_cache()
    return cache / emulator_layer(cache).name


def kernel_key() -> str:
    return definition.digest(definition.SUITE, definition.KERNEL)


def build_machine(path: Path, cache: Path) -> None:
    base = ensure_locked(cache, base_layer(cache))
    log = cache / "build.log"
    kernel = ensure_locked(cache, Layer("kernel", kernel_key(), lambda new: build_kernel(new, log)))
    with Stage("disk of the machine"):
        shutil.copy(next(kernel.glob("boot/vmlinuz-*")), path / "vmlinuz")
        write_initrd(kernel, path / "initrd")
        write_extras(path / "extras", kernel)
        write_disk(path, base, log)
    with Stage("first boot and snapshot of the machine"):
        write_snapshot(path, log)


def build_kernel(path: Path, log: Path) -> None:
    with Stage(definition.KERNEL):
        command = debian_command(path, "extract", [definition.KERNEL, "busybox-static"])
        run_logged(command, log, "download the kernel")


def write_extras(path: Path, kernel: Path) -> None:
    """What the machine has more than the container: laid over the tree."""
    library = path / "usr/local/lib/lab"
    wants = path / "etc/systemd/system/multi-user.target.wants"
    for directory in (library, wants, path / "usr/lib", path / "out"):
        directory.mkdir(parents=True, exist_ok=True)
    for name in ("__init__.py", "agent.py", "wire.py"):
        shutil.copy(definition.HERE / name, library)
    (wants.parent / "lab-agent.service").write_text(AGENT_UNIT, encoding="ascii")
    (wants / "lab-agent.service").symlink_to("../lab-agent.service")
    # No device needs it here, and it doubles the time of a boot.
    (wants.parent / "systemd-udev-trigger.service").symlink_to("/dev/null")
    modules = kernel / "usr/lib/modules"
    subprocess.run(["cp", "--archive", "--link", str(modules), str(path / "usr/lib")], check=True)


def write_disk(path: Path, base: Path, log: Path) -> None:
    (path / "merged").mkdir()
    script = (
        'mount -t overlay -o "lowerdir=$1/extras:$2" overlay "$1/merged" && '
        'mke2fs -q -t ext4 -d "$1/merged" -E lazy_itable_init=1 "$1/root.ext4" "$3"'
    )
    # In a mount namespace of its own: nothing to unmount, whatever happens.
    mount = ["unshare", "--mount", "sh", "-c", script, "sh", str(path), str(base), DISK]
    run_logged(mount, log, "make the disk")
    (path / "merged").rmdir()
    shutil.rmtree(path / "extras")


def write_snapshot(path: Path, log: Path) -> None:
    disk = path / "booted.qcow2"
    # A relative name, for the directory is renamed when it is finished.
    create = ["create", "-q", "-f", "qcow2", "-F", "raw", "-b", "root.ext4", str(disk)]
    run_logged([*program(find_emulator(), "qemu-img"), *create], log, "make the snapshot's disk")
    run = open_run()
    try:
        with started_machine(run, path, disk) as guest:
            guest.wait_boot(bound(BOOT_SECONDS))
            warm_up(guest)
            qemu.ask_monitor(run.directory, f"savevm {SNAPSHOT}")
    finally:
        close_run(run)


@contextmanager
def started_machine(run: Run, layer: Path, disk: Path, snapshot: str = "") -> Iterator[Guest]:
    command = qemu.machine_command(find_emulator(), layer, disk, run.directory, snapshot, MEMORY)
    # An image is built as quickly as can be.
    speed = read_speed(os.environ.get("LAB_SPEED")) if snapshot else FULL_SPEED
    try:
        with qemu.started(command, run.directory, speed) as port:
            yield Guest(port)
    except LabError as error:
        kept = find_cache() / "console.log"
        with suppress(FileNotFoundError):
            shutil.copy(run.directory / "console", kept)
        raise LabError(error.message, error.hint or f"see {kept}") from None


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


def run_in_machine(run: Run, layer: Path, options: Options) -> int:
    disk = layer / f"{run.name}.qcow2"
    note(run, "disk", disk)
    copy = ["cp", "--reflink=auto", "--sparse=auto", str(layer / "booted.qcow2"), str(disk)]
    subprocess.run(copy, check=True)
    with started_machine(run, layer, disk, SNAPSHOT) as guest:
        return run_commands(guest, options)


def run_commands(guest: Guest, options: Options) -> int:
    push_checkout(guest)
    status = 0
    for number, command in enumerate(options.commands):
        if number:
            reboot(guest)
        terminal = is_terminal()
        with kept_terminal():
            status = run_command(guest, service_command(command, options, terminal), options)
        if status:
            break
    if options.out:
        pull_out(guest, options.out)
    return status


def run_command(guest: Guest, command: Sequence[str], options: Options) -> int:
    if options.cuts:
        return guest.run_through_cuts(command, bound(3 * BOOT_SECONDS))
    return guest.run(command, is_terminal())


def push_checkout(guest: Guest) -> None:
    """And the editable install of it: the snapshot is older than that and outlives it."""
    added = ensure_tree(find_cache()) / DIFFERENCE, ensure_bytecode()
    # Its clock may be a second behind this one, and files of the checkout newer than that.
    quiet = ["--ignore-zeros", "--warning=no-timestamp"]
    guest.request(["tar", "--extract", *quiet, "--directory", "/"], resume=True)
    command = pack_command(definition.CHECKOUT, "--transform=flags=rhS;s,^\\.,src,")
    pack = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert pack.stdout
    with pack:
        guest.send_pieces(pack.stdout.fileno())
        for archive in added:
            with archive.open("rb") as rest:
                guest.send_pieces(rest.fileno())
    guest.send(b"I")
    check_packed(pack.returncode)
    check_guest(guest.wait_exit(write_out, write_err), "copy the checkout into")


def pull_out(guest: Guest, out: Path) -> None:
    unpack = subprocess.Popen(["tar", "--extract", "--directory", str(out)], stdin=subprocess.PIPE)
    assert unpack.stdin
    guest.request(["tar", "--create", "--directory", "/out", "."])
    with unpack:
        status = guest.wait_exit(partial(write_all, unpack.stdin.fileno()), write_err)
    check_guest(status or unpack.returncode, "copy /out from")


def check_guest(status: int, what: str) -> None:
    if status:
        raise LabError(f"{what} the machine", "is there space on the disk?")


def reboot(guest: Guest) -> None:
    guest.request(["systemctl", "reboot"])
    guest.wait_boot(bound(BOOT_SECONDS))

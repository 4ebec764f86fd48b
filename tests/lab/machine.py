"""LAB=vm and LAB=emulator: commands in a machine with a kernel of its own, and its reboots."""

import shutil
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lab import definition
from lab.bytecode import ensure_bytecode
from lab.cache import find_cache
from lab.errors import LabError
from lab.guest import Guest, write_all, write_err, write_out
from lab.image import DIFFERENCE, check_packed, ensure_tree, pack_command
from lab.options import Options
from lab.pace import bound
from lab.runs import Run
from lab.service import service_command
from lab.snapshot import BOOT_SECONDS, resumed
from lab.terminal import is_terminal, kept_terminal
from lab.user_kernel import booted_user_kernel

COPY = "copy the checkout into"
UNPACK = """\
mount -t hostfs -o hostfs=/share share /mnt
for one in /mnt/*.tar; do tar --extract --file="$one" --directory=/; done
umount /mnt
"""


def run_in_vm(run: Run, disk: Path, options: Options) -> int:
    with booted_user_kernel(run, disk) as guest:
        share_checkout(guest, run.directory / "share")
        return run_commands(guest, options)


def run_in_emulator(run: Run, snapshot: Path, options: Options) -> int:
    with resumed(run, snapshot) as guest:
        push_checkout(guest)
        return run_commands(guest, options)


def share_checkout(guest: Guest, share: Path) -> None:
    """And the editable install of it: the disk is older than that and outlives it."""
    pack = subprocess.run([*checkout_command(), f"--file={share / 'src.tar'}"], check=False)
    check_packed(pack.returncode)
    for number, archive in enumerate(added_archives()):
        shutil.copy(archive, share / f"added-{number}.tar")
    check_guest(guest.run_quietly(["sh", "-ec", UNPACK]), COPY)


def push_checkout(guest: Guest) -> None:
    """As for a shared one, through the port of the agent."""
    # Its clock may be a second behind this one, and files of the checkout newer than that.
    quiet = ["--ignore-zeros", "--warning=no-timestamp"]
    guest.request(["tar", "--extract", *quiet, "--directory", "/"], resume=True)
    pack = subprocess.Popen(checkout_command(), stdout=subprocess.PIPE)
    assert pack.stdout
    with pack:
        guest.send_pieces(pack.stdout.fileno())
        for archive in added_archives():
            with archive.open("rb") as rest:
                guest.send_pieces(rest.fileno())
    guest.send(b"I")
    check_packed(pack.returncode)
    check_guest(guest.wait_exit(write_out, write_err), COPY)


def checkout_command() -> list[str]:
    return pack_command(definition.CHECKOUT, "--transform=flags=rhS;s,^\\.,src,")


def added_archives() -> list[Path]:
    return [ensure_tree(find_cache()) / DIFFERENCE, ensure_bytecode()]


def run_commands(guest: Guest, options: Options) -> int:
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

"""LAB=vm: a kernel of its own that is a process of this one, see UML in the kernel's documentation.

It runs programs three to ten times faster than an emulator, and boots in five seconds. Debian has
it built with cgroup v2 and its limits, but without PSI, cpusets and a second processor. That of
Debian 13 does not start on processors with AMX.
"""

import os
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lab import cgroup, definition
from lab.cache import Layer, ensure, find_cache
from lab.disk import NAME, disk_layer
from lab.errors import LabError
from lab.guest import Guest
from lab.image import unpacked_layer
from lab.line import steady_line
from lab.pace import bound
from lab.process import die_with_parent, need_tools, read_last_line
from lab.runs import CONSOLE, Run, note, remove_cgroup, with_console
from lab.slow import read_speed, slowed

PACKAGES = ["user-mode-linux", "libc6"]
MEMORY = "2G"
BOOT_SECONDS = 60.0

# All of it in a mount namespace of its own: nothing to unmount, whatever happens. $1 is the kernel
# with its library, $2 the directory of the disk, $3 that of the run. The machine's memory is a file
# in /tmp.
SCRIPT = """\
set -e
root=$3/root kernel=$1 disk=$2; run=$3; shift 3
mkdir "$root" "$run/share"
mount -t tmpfs -o size=3G lab "$root"
mkdir "$root/usr" "$root/proc" "$root/dev" "$root/disk" "$root/share" "$root/tmp"
mount --bind "$kernel/usr" "$root/usr"
ln -s usr/lib usr/lib64 "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --bind "$disk" "$root/disk"
mount --bind "$run/share" "$root/share"
exec env -i HOME=/tmp TMPDIR=/tmp "$(command -v chroot)" "$root" "$@"
"""


def ensure_user_kernel(cache: Path) -> Path:
    """The directory of its disk."""
    need_tools("mmdebstrap", "mke2fs")
    ensure(cache, user_kernel_layer(cache))
    return ensure(cache, disk_layer(cache))


def user_kernel_layer(cache: Path) -> Layer:
    return unpacked_layer(cache, "user-kernel", PACKAGES, definition.NEW_SUITE)


@contextmanager
def booted_user_kernel(run: Run, disk: Path) -> Iterator[Guest]:
    cache = find_cache()
    kernel = cache / user_kernel_layer(cache).name
    speed = read_speed(os.environ.get("LAB_SPEED"))
    changes = disk / f"{run.name}.cow"
    note(run, "disk", changes)
    ours, theirs = socket.socketpair()
    words = kernel_command(theirs.fileno(), changes.name)
    place = [str(kernel), str(disk), str(run.directory)]
    enter, group = cgroup.enter_command(run.name)
    note(run, "cgroup", group)
    script = ["unshare", "--mount", "--propagation", "private", "sh", "-c", SCRIPT, "sh", *place]
    with ours, (run.directory / CONSOLE).open("wb") as log:
        process = subprocess.Popen(
            [*enter, *die_with_parent([*script, *words])],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            pass_fds=[theirs.fileno()],
            start_new_session=True,
        )
        theirs.close()
        try:
            with slowed(process, speed), steady_line(ours) as port:
                guest = Guest(port)
                guest.wait_boot(bound(BOOT_SECONDS))
                yield guest
        except LabError as error:
            last = read_last_line(run.directory / CONSOLE)
            raise with_console(LabError(f"{error.message}: {last}", error.hint), run) from None
        finally:
            remove_cgroup(group)
            process.kill()
            process.wait()


def kernel_command(port: int, changes: str) -> list[str]:
    return [
        "/usr/bin/linux.uml", f"mem={MEMORY}", "seccomp=on",
        f"ubd0=/disk/{changes},/disk/{NAME}", "root=/dev/ubda", "rw",
        "con=null", "con0=null,fd:1", f"ssl0=fd:{port},fd:{port}", "quiet", "loglevel=3", "panic=1",
    ]  # fmt: skip

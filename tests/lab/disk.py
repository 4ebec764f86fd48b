"""The disk of a machine: the base as a file system, and the agent that runs commands there."""

import shutil
import subprocess
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import base_layer, unpacked_layer
from lab.process import run_logged

SIZE = "6G"
NAME = "root.ext4"
SOURCES = ("disk.py", "agent.py", "wire.py")

AGENT_UNIT = """\
[Unit]
Description=Runs the commands of the lab
[Service]
ExecStart=/usr/bin/python3 -m lab.agent
WorkingDirectory=/usr/local/lib
Restart=always
OOMScoreAdjust=-1000
"""

# What systemd-coredump needs; a library of elfutils finds the names of functions.
COREDUMP_FILES = (
    *("usr/lib/systemd/systemd-coredump", "usr/bin/coredumpctl", "usr/lib/*/lib*dw*.so*"),
    *("usr/lib/*/libelf*.so*", "usr/lib/systemd/system/systemd-coredump*"),
    *("usr/lib/systemd/system/*.wants/systemd-coredump*", "usr/lib/sysctl.d/50-coredump.conf"),
    *("usr/lib/sysusers.d/systemd-coredump.conf", "etc/systemd/coredump.conf"),
)

# The modules of a kernel in user mode lie beside it, see user_kernel.py.
MODULES_MOUNT = """\
[Unit]
Description=Modules of a kernel in user mode
ConditionVirtualization=uml
DefaultDependencies=no
Before=local-fs.target
[Mount]
What=modules
Where=/usr/lib/modules
Type=hostfs
Options=ro,hostfs=/usr/lib/uml/modules
"""


def disk_layer(cache: Path) -> Layer:
    sources = [definition.read_part(definition.HERE / name) for name in SOURCES]
    layers = (kernel_layer(cache).key, coredump_layer(cache).key)
    key = definition.digest(definition.base_key(), *layers, sources)
    return Layer("disk", key, lambda path: build_disk(path, cache))


def kernel_layer(cache: Path) -> Layer:
    """Debian's own kernel, for an emulator."""
    return unpacked_layer(cache, "kernel", [definition.KERNEL, "busybox-static"])


def coredump_layer(cache: Path) -> Layer:
    """For a kernel that is not shared with the host, which has its own kernel.core_pattern."""
    return unpacked_layer(cache, "coredump", ["systemd-coredump", "libdw1t64"])


def build_disk(path: Path, cache: Path) -> None:
    base = ensure(cache, base_layer(cache))
    kernel = ensure(cache, kernel_layer(cache))
    coredump = ensure(cache, coredump_layer(cache))
    with Stage("disk of the machine"):
        write_extras(path / "extras", kernel)
        copy_coredump(coredump, path / "extras")
        write_disk(path, base, cache / "disk.log")


def write_extras(path: Path, kernel: Path) -> None:
    """What the machine has more than the container: laid over the tree."""
    library = path / "usr/local/lib/lab"
    wants = path / "etc/systemd/system/multi-user.target.wants"
    for directory in (library, wants, path / "usr/lib", path / "out"):
        directory.mkdir(parents=True, exist_ok=True)
    for name in ("__init__.py", "agent.py", "wire.py"):
        shutil.copy(definition.HERE / name, library)
    for name, text in (("lab-agent.service", AGENT_UNIT), ("usr-lib-modules.mount", MODULES_MOUNT)):
        (wants.parent / name).write_text(text, encoding="ascii")
        (wants / name).symlink_to(f"../{name}")
    # No device needs it here, and it doubles the time of a boot.
    (wants.parent / "systemd-udev-trigger.service").symlink_to("/dev/null")
    modules = kernel / "usr/lib/modules"
    subprocess.run(["cp", "--archive", "--link", str(modules), str(path / "usr/lib")], check=True)


def copy_coredump(source: Path, path: Path) -> None:
    """Of the unpacked packages what the base does not have."""
    for pattern in COREDUMP_FILES:
        for one in source.glob(pattern):
            target = path / one.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(one, target, follow_symlinks=False)


def write_disk(path: Path, base: Path, log: Path) -> None:
    (path / "merged").mkdir()
    script = (
        'mount -t overlay -o "lowerdir=$1/extras:$2" overlay "$1/merged" && '
        'mke2fs -q -t ext4 -d "$1/merged" -E lazy_itable_init=1 "$1/$3" "$4"'
    )
    # In a mount namespace of its own: nothing to unmount, whatever happens.
    mount = ["unshare", "--mount", "sh", "-c", script, "sh", str(path), str(base), NAME, SIZE]
    run_logged(mount, log, "make the disk")
    (path / "merged").rmdir()
    shutil.rmtree(path / "extras")

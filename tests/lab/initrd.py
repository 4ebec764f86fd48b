"""The smallest first file system: a shell and the one module that the root needs.

Debian's own costs more than three seconds of boot, and nvme, which needs none, no snapshots.
"""

import lzma
from pathlib import Path

INIT = """\
#!/bin/busybox sh
set -e
/bin/busybox mount -t devtmpfs dev /dev
/bin/busybox mount -t proc proc /proc
/bin/busybox mount -t sysfs sys /sys
/bin/busybox insmod /virtio_blk.ko
while [ ! -b /dev/vda ]; do /bin/busybox sleep 0.01; done
/bin/busybox mount -t ext4 -o rw,noatime /dev/vda /root
for place in dev proc sys; do /bin/busybox mount -o move /$place /root/$place; done
exec /bin/busybox switch_root /root /sbin/init
"""


def write_initrd(kernel_tree: Path, target: Path) -> None:
    module = next(kernel_tree.glob("usr/lib/modules/*/kernel/drivers/block/virtio_blk.ko.xz"))
    entries = [(name, 0o040755, b"") for name in ("bin", "dev", "proc", "root", "sys")]
    entries += [
        ("bin/busybox", 0o100755, (kernel_tree / "usr/bin/busybox").read_bytes()),
        ("virtio_blk.ko", 0o100644, lzma.decompress(module.read_bytes())),
        ("init", 0o100755, INIT.encode()),
        ("TRAILER!!!", 0, b""),
    ]
    target.write_bytes(b"".join(format_entry(*entry) for entry in entries))


def format_entry(name: str, mode: int, data: bytes) -> bytes:
    """One member of a cpio archive of the kind "newc", the only one the kernel reads."""
    path = name.encode() + b"\0"
    inode, owner, group, links, time, device = 0, 0, 0, 1, 0, (0, 0, 0, 0)
    numbers = (inode, mode, owner, group, links, time, len(data), *device, len(path), 0)
    head = b"070701" + b"".join(b"%08X" % number for number in numbers)
    return pad(head + path) + pad(data)


def pad(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)

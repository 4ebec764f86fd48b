"""The devices that needs open in the sandbox: the group of a device, because it comes and goes.

DeviceAllow= with a path is resolved when the unit starts, so a device that is plugged in later
would stay closed. A group of /proc/devices stands for all devices of one driver, see
systemd.resource-control(5).
"""

import re
from collections.abc import Iterable

from dora_systemd.decisions.cell.needs import NodeNeed

_SERIAL = ("char-ttyUSB", "char-ttyACM")
_GROUPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    (r"video\d+|v4l/.*|v4l-subdev\d+|vbi\d+|radio\d+", ("char-video4linux",)),
    (r"media\d+", ("char-media",)),
    (r"ttyUSB\d+", ("char-ttyUSB",)),
    (r"ttyACM\d+", ("char-ttyACM",)),
    (r"serial/.*", _SERIAL),
    (r"ttyS\d+", ("char-ttyS",)),
    (r"ttyAMA\d+", ("char-ttyAMA",)),
    (r"rfcomm\d+", ("char-rfcomm",)),
    (r"input/.*", ("char-input",)),
    (r"hidraw\d+", ("char-hidraw",)),
    (r"snd/.*", ("char-alsa",)),
    (r"i2c-\d+", ("char-i2c",)),
    (r"spidev[\d.]+", ("char-spi",)),
    (r"gpiochip\d+", ("char-gpiochip",)),
    (r"iio:device\d+", ("char-iio",)),
    (r"bus/usb/.*", ("char-usb_device",)),
    (r"dri/.*", ("char-drm",)),
    (r"pts/\d+", ("char-pts",)),
    (r"loop\d+.*", ("block-loop",)),
    (r"sd[a-z]+\d*", ("block-sd",)),
    (r"mmcblk\d+.*", ("block-mmc",)),
)
_ALWAYS = frozenset(f"/dev/{one}" for one in ("null", "zero", "full", "random", "urandom", "tty"))
"""Devices that no sandbox closes, see DevicePolicy= in systemd.resource-control(5)."""


def device_entries(needs: Iterable[NodeNeed]) -> tuple[str, ...]:
    """The values of DeviceAllow= for what nodes need below /dev."""
    entries = (entry for one in needs for entry in _entries(one.path))
    return tuple(dict.fromkeys(f"{entry} rw" for entry in entries))


def lone_devices(needs: Iterable[NodeNeed]) -> tuple[NodeNeed, ...]:
    """The needed devices that have no group here: they stay closed unless the start finds them."""
    return tuple(one for one in needs if one.path not in _ALWAYS and one.path in _entries(one.path))


def _entries(path: str) -> tuple[str, ...]:
    if not is_device(path):
        return ()
    for pattern, groups in _GROUPS:
        if re.fullmatch(pattern, path.removeprefix("/dev/")):
            return groups
    return (path,)


def is_device(path: str) -> bool:
    """Whether the path is below /dev, and not of the memory that every process may use."""
    return path.startswith("/dev/") and not path.startswith(("/dev/shm/", "/dev/mqueue/"))

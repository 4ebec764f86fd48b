"""What needs become in the unit of a dataflow, and the names of units that a start waits for. Pure.

Needs of the whole dataflow are dependencies, see systemd.unit(5). systemd waits for them before it
starts the runner, so no restart and no timeout is used up.

Devices that nodes need are opened in the sandbox by the group of the device: DeviceAllow= with a
path is resolved when the unit starts, so a device that is plugged in later would stay closed. A
group of /proc/devices stands for all devices of one driver, see systemd.resource-control(5). A CAN
bus is opened by its socket family.
"""

import re
from collections.abc import Iterable

from dora_systemd.decisions.needs.words import CLOCK, DATAFLOW, MOUNT, NET, NETWORK, UNIT, NodeNeed
from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.names import name_from_unit, unit_name

NETWORK_UNIT = "network-online.target"
CLOCK_UNIT = "time-sync.target"
CHRONY, TIMESYNCD = "chrony-wait.service", "systemd-time-wait-sync.service"
CLOCK_WAITERS = (CHRONY, TIMESYNCD)
"""The services that wait until the clock is right; time-sync.target alone waits for nothing."""


def required_units(needs: tuple[str, ...]) -> dict[str, str]:
    """Return the unit that has to run for as long as the dataflow does, by need."""
    units = {one: one.removeprefix(UNIT) for one in needs if one.startswith(UNIT)}
    dataflows = (one for one in needs if one.startswith(DATAFLOW))
    return units | {one: unit_name(one.removeprefix(DATAFLOW)) for one in dataflows}


def needed_mounts(needs: tuple[str, ...]) -> list[str]:
    """The paths whose file systems are needed."""
    return [one.removeprefix(MOUNT) for one in needs if one.startswith(MOUNT)]


def needs_properties(needs: tuple[str, ...], clock: str) -> dict[str, Property]:
    """The dependencies. clock: the one of CLOCK_WAITERS that works here, or "".

    Requires=, not BindsTo=: a stop of the other unit stops the dataflow in both, but systemd only
    starts the dataflow again after a failure of the other unit if that is required.
    """
    wanted = [NETWORK_UNIT] if NETWORK in needs else []
    wanted += [CLOCK_UNIT, *([clock] if clock else [])] if CLOCK in needs else []
    # As in a unit file, in which the escapes of a unit's name have to be escaped.
    required = [one.replace("\\", "\\\\") for one in required_units(needs).values()]
    lines = [f"Wants={one}" for one in wanted]
    lines += [f"Requires={one}" for one in required]
    lines += [f"After={one}" for one in (*wanted, *required)]
    mounts = tuple(needed_mounts(needs))
    return with_assignments({}, lines) | (typed(RequiresMountsFor=mounts) if mounts else {})


_MOST = 3
"""Needs that are named."""
_OF_ALL = ("basic.target", "sysinit.target", "systemd-journald.socket")
"""Units for which systemd lets all services wait during the boot; the slice is one, too."""
_MOUNT_SUFFIX = ".mount"
_ESCAPED = rb"\\x([0-9a-f]{2})|-"


def format_awaited(units: Iterable[str]) -> str:
    """Format "dataflow base, network"; "" without any. units: whose jobs the start waits for.

    Units for which all services wait are named only if there is no other unit.
    """
    known = sorted(units)
    words = list(dict.fromkeys(map(_need_word, own_units(known) or known)))
    more = len(words) - _MOST
    return ", ".join(words[:_MOST]) + (f" and {more} more" if more > 0 else "")


def own_units(units: Iterable[str]) -> list[str]:
    """Return those of `units` for which not all services wait."""
    return [one for one in units if one not in _OF_ALL and not one.endswith(".slice")]


def _need_word(unit: str) -> str:
    """The need from which a unit was derived, else the unit."""
    if unit == NETWORK_UNIT:
        return NETWORK
    if unit in (CLOCK_UNIT, *CLOCK_WAITERS):
        return CLOCK
    if name := name_from_unit(unit):
        return f"dataflow {name}"
    return (
        f"mount {_unescaped(unit.removesuffix(_MOUNT_SUFFIX))}"
        if unit.endswith(_MOUNT_SUFFIX)
        else unit
    )


def _unescaped(name: str) -> str:
    """Unescape a path as systemd-escape(1) --unescape --path does."""
    parts = re.sub(
        _ESCAPED, lambda match: bytes.fromhex((match[1] or b"2f").decode()), name.encode()
    )
    return f"/{parts.decode(errors='replace').lstrip('/')}"


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
    entries = (entry for one in needs for entry in _entries(one.what))
    return tuple(dict.fromkeys(f"{entry} rw" for entry in entries))


def needs_can(needs: Iterable[NodeNeed]) -> bool:
    """Whether a node needs an interface that is a CAN bus by its name: it may not exist yet."""
    return any(one.what.startswith(NET) and "can" in one.what.lower() for one in needs)


def lone_devices(needs: Iterable[NodeNeed]) -> tuple[NodeNeed, ...]:
    """The needed devices that have no group here: they stay closed unless the start finds them."""
    return tuple(one for one in needs if one.what not in _ALWAYS and one.what in _entries(one.what))


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

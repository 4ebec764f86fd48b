"""A device that the kernel adds and removes, as one on a cable: HID, made by uhid.

See Documentation/hid/uhid.rst of the kernel. udev(7) hears of it as of any other device.
"""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.system.cells import run

_MODULES = ("hid", "hid-generic", "uhid")
_CREATE, _CREATE_FORM = 11, "<I128s64s64sHHIIII4096s"
_USB, _ANY = 3, 0
_REPORT = bytes.fromhex("0600ff 0901 a101 1500 26ff00 7508 9508 0901 8102 c0")
"""The descriptor of a device of a vendor's own kind, which sends eight bytes."""


def load_modules() -> None:
    """Load the driver, from files: the machine has no list of its modules."""
    for name in _MODULES:
        if not Path("/sys/module", name.replace("-", "_")).exists():
            place = f"/lib/modules/{os.uname().release}/kernel/drivers/hid"
            run("insmod", f"{place}/{name}.ko.xz")


@contextmanager
def plugged(name: str) -> Iterator[None]:
    """Plug a device of that name in; unplug it afterwards."""
    words = (name.encode(), b"", b"", len(_REPORT), _USB, 0x1209, 1, 0, _ANY, _REPORT)
    device = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
    try:
        os.write(device, struct.pack(_CREATE_FORM, _CREATE, *words))
        yield
    finally:
        os.close(device)

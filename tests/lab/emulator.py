"""The emulator of Debian 13, whatever this machine has.

QEMU before 10 spoils the flags after cmpxchg16b (half of all boots panic), and a fork and exec in
the machine takes it four times longer. It is unpacked, not installed: its own loader starts it.
"""

from pathlib import Path

from lab.cache import Layer
from lab.image import unpacked_layer

PACKAGES = ["qemu-system-x86", "qemu-utils"]
LIBRARIES = "usr/lib/x86_64-linux-gnu"


def emulator_layer(cache: Path) -> Layer:
    return unpacked_layer(cache, "emulator", PACKAGES)


def program(layer: Path, name: str) -> list[str]:
    """The beginning of a command line that runs a program of the layer with its own libraries."""
    loader = layer / "usr/lib64/ld-linux-x86-64.so.2"
    modules = f"QEMU_MODULE_DIR={layer / LIBRARIES / 'qemu'}"
    libraries = ["--library-path", str(layer / LIBRARIES)]
    return ["env", modules, str(loader), *libraries, str(layer / "usr/bin" / name)]


def firmware(layer: Path) -> list[str]:
    """Where the emulator finds what a machine starts with, as options of it."""
    places = (layer / "usr/share/qemu", layer / "usr/share/seabios")
    return [word for place in places for word in ("-L", str(place))]

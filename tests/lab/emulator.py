"""The emulator of Debian 13, whatever this machine has.

QEMU before 10 spoils the flags after cmpxchg16b (half of all boots panic), and a fork and exec in
the machine takes it four times longer. It is unpacked, not installed: its own loader starts it.
"""

from pathlib import Path

from lab import definition
from lab.cache import Layer
from lab.errors import Stage
from lab.image import debian_command
from lab.process import run_logged

PACKAGES = ["qemu-system-x86", "qemu-utils"]
LIBRARIES = "usr/lib/x86_64-linux-gnu"


def emulator_layer(cache: Path) -> Layer:
    return Layer("emulator", key(), lambda path: build_emulator(path, cache / "build.log"))


def key() -> str:
    return definition.digest(definition.SUITE, PACKAGES)


def build_emulator(path: Path, log: Path) -> None:
    with Stage(f"emulator of Debian {definition.SUITE}"):
        run_logged(debian_command(path, "extract", PACKAGES), log, "download the emulator")


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

"""LAB=bookworm, LAB=forky: systemd-coredump beside the tree, for a test that calls it by hand.

It is not installed: the kernel gives core dumps to the host of a container.
"""

import shutil
from functools import partial
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.disk import copy_coredump
from lab.image import unpacked_layer
from lab.openarm import copy_tree
from lab.platforms import ensure_platform

PLACE = "opt/coredump"
PACKAGES = {
    definition.OLD_SUITE: ["systemd-coredump", "libdw1"],
    definition.NEW_SUITE: ["systemd-coredump", "libdw1t64"],
}


def ensure_with_coredump(cache: Path, suite: str) -> Path:
    platform = ensure_platform(cache, suite)
    unpacked = unpacked_layer(cache, f"coredump-{suite}", PACKAGES[suite], suite)
    key = definition.digest(platform.name, unpacked.key, definition.read_part(Path(__file__)))
    build_whole = partial(build, cache=cache, platform=platform, unpacked=unpacked)
    return ensure(cache, Layer(f"{suite}-whole", key, build_whole))


def build(path: Path, cache: Path, platform: Path, unpacked: Layer) -> None:
    copy_tree(platform, path, cache / f"{unpacked.kind}.log")
    source = ensure(cache, unpacked)
    copy_coredump(source, path / PLACE)
    # Packages of Debian 12 have files in /lib, which is a link where they are installed.
    for one in source.glob("lib/systemd/**/*coredump*"):
        target = path / PLACE / "usr" / one.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(one, target, follow_symlinks=False)

"""Layers of images on disk: found by key, built under a lock, the old ones removed."""

import fcntl
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lab.errors import say

# The newest and one more, so that two checkouts can take turns without building each time.
KEEP = 2
BUILDS = "build.lock"
"""All builds hold this lock together, and whoever removes everything holds it alone."""


@dataclass(frozen=True)
class Layer:
    kind: str
    key: str
    build: Callable[[Path], None]

    @property
    def name(self) -> str:
        return f"{self.kind}-{self.key}"


def find_cache() -> Path:
    chosen = os.environ.get("DORA_LAB_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(chosen).absolute() if chosen else Path(home) / "dora-systemd-lab"
    path.mkdir(parents=True, exist_ok=True)
    return path


def take_lock(path: Path, operation: int) -> int:
    """The lock lives as long as the descriptor, so it cannot outlive a killed process."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, operation)
    except BlockingIOError:
        os.close(descriptor)
        raise
    return descriptor


def try_lock(path: Path) -> int | None:
    try:
        return take_lock(path, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return None


def ensure(cache: Path, layer: Layer) -> Path:
    """The finished directory of the layer, held against removal until this process ends."""
    path = cache / layer.name
    # Held before it is looked for: the one who removes holds the same lock alone.
    held = take_lock(cache / f"{layer.name}.lock", fcntl.LOCK_SH)
    if path.exists():
        os.utime(path)
        return path
    os.close(held)
    build_alone(cache, layer)
    return ensure(cache, layer)


def build_alone(cache: Path, layer: Layer) -> None:
    """Build it, or wait until another process has. Layers of other kinds are built meanwhile.

    A layer that is made of others has `ensure()` build them: no two kinds need each other.
    """
    shared = take_lock(cache / BUILDS, fcntl.LOCK_SH)
    path = cache / f"{layer.kind}.build.lock"
    lock = try_lock(path)
    if lock is None:
        say(f"another build of this is running, waiting for it: {layer.kind} ...")
        lock = take_lock(path, fcntl.LOCK_EX)
    try:
        if not (cache / layer.name).exists():
            build_layer(cache, layer)
    finally:
        os.close(lock)
        os.close(shared)


def build_layer(cache: Path, layer: Layer) -> None:
    for left in cache.glob(f"{layer.kind}-*.tmp"):  # by a build that was killed
        shutil.rmtree(left)
    unfinished = cache / f"{layer.name}.tmp"
    unfinished.mkdir()
    layer.build(unfinished)
    # The rename is what finishes it: no interrupted build ever has this name.
    unfinished.rename(cache / layer.name)
    for old in find_old(cache, layer):
        remove_layer(old)


def find_old(cache: Path, layer: Layer) -> list[Path]:
    found = [path for path in cache.glob(f"{layer.kind}-*") if path.is_dir()]
    found.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    return [path for path in found[KEEP:] if path.name != layer.name]


def remove_layer(path: Path) -> None:
    lock_path = path.with_name(f"{path.name}.lock")
    lock = try_lock(lock_path)
    if lock is None:
        return
    shutil.rmtree(path)
    lock_path.unlink()
    os.close(lock)


def remove_all(cache: Path) -> None:
    """Remove all layers that nobody uses, when nobody builds one."""
    alone = take_lock(cache / BUILDS, fcntl.LOCK_EX)
    for path in cache.iterdir():
        if path.is_dir():
            remove_layer(path)
    os.close(alone)

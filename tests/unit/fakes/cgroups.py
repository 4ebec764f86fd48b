"""A cgroup2 hierarchy of ordinary files."""

from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup import groups


def fake_cgroups(patch: pytest.MonkeyPatch, root: Path) -> Path:
    """From now on the hierarchy is mounted at the directory that this makes below `root`."""
    mount = root / "cgroup"
    mount.mkdir(exist_ok=True)
    patch.setattr(groups, "mount_point", lambda: mount)
    return mount

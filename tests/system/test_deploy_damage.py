"""A disk that changes what a release contains: no later release gets that."""

import os

import pytest

from tests.system.cells import Project
from tests.system.releases import Releases, differences, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

FAST = ("--soak", "0s")


def test_what_the_disk_has_changed_is_copied_again(releases: Releases, project: Project) -> None:
    """Size, times and mode are as before; links to that content would spread it."""
    write_version(project, "1")
    for name in ("model.bin", "map.bin"):
        project.write(name, name * 1000)
    releases.deploy(project.root, *FAST)
    first = releases.current()
    file = releases.path / first / "tree/model.bin"
    before = file.stat()
    with file.open("r+b") as opened:
        opened.write(b"M")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    said = releases.deploy(project.root, *FAST)
    assert f"release {first} is damaged: model.bin changed on the disk;" in said
    second = releases.current()
    assert (differences(releases.path / first), differences(releases.path / second)) == (
        ["model.bin"],
        [],
    )
    links = {name: releases.path / second / "tree" / name for name in ("model.bin", "map.bin")}
    assert {name: path.stat().st_nlink for name, path in links.items()} == {
        "model.bin": 1,
        "map.bin": 2,
    }
    assert "damaged" not in releases.deploy(project.root, *FAST)

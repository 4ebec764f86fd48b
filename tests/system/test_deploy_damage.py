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


def test_a_damaged_release_does_not_come_back(releases: Releases, project: Project) -> None:
    """A rollback runs what has proved itself, or nothing new."""
    first, second = versions(releases, project)
    file = releases.path / first / "tree/model.bin"
    file.write_bytes(file.read_bytes()[:-1])
    refused = releases.cell.doractl("rollback", releases.cell.name, check=False)
    assert refused.returncode == 5
    assert f"cannot run release {first} of" in refused.stderr
    assert "it is damaged: model.bin changed on the disk" in refused.stderr
    assert "check the disk" in refused.stderr
    assert (releases.running(), releases.current()) == (second, second)


def versions(releases: Releases, project: Project) -> tuple[str, str]:
    """Deploy two; only the first one has its model."""
    write_version(project, "1")
    project.write("model.bin", "model")
    releases.deploy(project.root, *FAST)
    first = releases.current()
    write_version(project, "2")
    project.write("model.bin", "another")
    releases.deploy(project.root, *FAST)
    return first, releases.current()

"""A full disk at each file that deploy creates, and two deploys at once."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.store import HISTORY
from dora_systemd.errors import ExitCode
from tests.system.cells import Project, run
from tests.system.deploy.runs import begin, deploy_words
from tests.system.releases import CONTROL, ETC, Releases, write_version

# They write to /etc and /var/lib.
pytestmark = pytest.mark.lab

NO_SPACE = "No space left on device"
MANY = 100
"""Files that a deploy creates in one directory, and more."""


class Disk:
    """A file system of its own over a directory, whose room for files can be taken away."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def give(self, count: int) -> None:
        """Let it have room for this number of files more; 0 for none."""
        free = int(run("stat", "--file-system", "--format=%d", str(self.place)).stdout)
        whole = int(run("stat", "--file-system", "--format=%c", str(self.place)).stdout)
        run("mount", "-o", f"remount,nr_inodes={whole - free + count}", str(self.place))


@contextmanager
def disk(releases: Releases, place: Path) -> Iterator[Disk]:
    """Over a directory, with what is there."""
    place.mkdir(parents=True, exist_ok=True)
    copy = place.with_name(f"{place.name}.copy")
    run("cp", "--archive", str(place), str(copy))
    run("mount", "-t", "tmpfs", "-o", "size=1M,mode=0755", "none", str(place))
    run("cp", "--archive", f"{copy}/.", str(place))
    shutil.rmtree(copy)
    try:
        yield Disk(place)
    finally:
        releases.cell.end()
        run("umount", "--lazy", str(place))
        run("systemctl", "daemon-reload")


def test_no_room_in_the_store(releases: Releases, project: Project) -> None:
    """Whatever file of a release is the first without room, the old release runs on."""
    write_version(project, "old")
    with disk(releases, releases.path) as room:
        releases.deploy(project.root, "--soak", "0s")
        old, life = releases.current(), releases.cell.show("InvocationID")
        project.write("model.bin", "x" * 2_000_000)
        assert NO_SPACE in releases.deploy(project.root, status=ExitCode.FAILURE)
        assert releases.cell.show("InvocationID") == life
        (project.root / "model.bin").unlink()
        write_version(project, "new")
        status, words = ExitCode.FAILURE, deploy_words(releases, project.root)
        for count in range(MANY):
            room.give(count)
            done = releases.cell.doractl(*words, check=False)
            status = ExitCode(done.returncode)
            if status is not ExitCode.FAILURE:
                break
            assert done.stderr.splitlines()[-2].endswith(NO_SPACE), done.stderr
            assert {one.name for one in releases.path.iterdir()} == {old, HISTORY}
        # The last of them notes that the release has passed its trial.
        assert (status, count > 3) == (ExitCode.ROLLED_BACK, True)
        assert NO_SPACE in done.stderr
        assert "runs again" in done.stderr
        releases.check_only(old)
        room.give(MANY)
        releases.deploy(project.root, "--soak", "0s")


@pytest.mark.parametrize("place", [ETC, CONTROL], ids=["commit", "trial"])
def test_no_room_for_the_unit_file(releases: Releases, project: Project, place: Path) -> None:
    """A trial that cannot begin stops nothing; one that cannot be committed is undone."""
    write_version(project, "old")
    releases.deploy(project.root, "--soak", "0s")
    old, life = releases.current(), releases.cell.show("InvocationID")
    status = ExitCode.ROLLED_BACK if place == ETC else ExitCode.FAILURE
    write_version(project, "new")
    with disk(releases, place) as room:
        room.give(0)
        said = releases.deploy(project.root, "--soak", "0s", status=status)
        assert NO_SPACE in said
        assert (releases.cell.show("InvocationID") == life) == (place == CONTROL)
        releases.check_only(old)
        assert not list(place.glob(".dora-*"))


def test_two_at_once(releases: Releases, project: Project) -> None:
    """One is refused, whichever it is; so is a rollback."""
    write_version(project, "old")
    releases.deploy(project.root, "--soak", "0s")
    write_version(project, "new")
    words = deploy_words(releases, project.root)
    with begin(releases, *words) as first, begin(releases, *words) as second:
        said = [one.communicate()[1] for one in (first, second)]
    codes = [first.returncode, second.returncode]
    assert sorted(codes) == [ExitCode.OK, ExitCode.FAILURE], said
    refused = said[codes.index(ExitCode.FAILURE)]
    assert "another deploy or rollback is at it" in refused
    new = releases.current()
    assert list(releases.states().values()) == ["current", "proved"]
    releases.check_only(new)

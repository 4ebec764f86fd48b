"""What is at a path, and being woken when that changes: real inotify, no time is measured."""

import asyncio
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from dora_systemd.adapters.host.presence import are_devices, look_at, watched_places
from dora_systemd.runner.needs import Watch

LONG = 60.0
"""Seconds; a test that waits for so long has failed."""


async def woken(watch: Watch) -> bool:
    """Whether a change wakes the task, and not the time."""
    async with asyncio.timeout(LONG):
        await watch.wait(10 * LONG)
    watch.clear()
    return True


def test_a_link_far_away_is_followed_and_watched(tmp_path: Path) -> None:
    real, link = tmp_path / "dev" / "video0", tmp_path / "by-id" / "camera"
    link.parent.mkdir()
    link.symlink_to("../dev/video0")
    assert look_at(str(link)).reason == "not there"
    assert watched_places([str(link)]) >= {str(link.parent), str(tmp_path)}
    real.parent.mkdir()
    real.touch()
    assert look_at(str(link)).reason == ""
    assert str(real.parent) in watched_places([str(link)])


def test_links_in_a_circle_are_never_there(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert look_at(str(tmp_path / "a")).reason == "not there"
    assert watched_places([str(tmp_path / "a")])


def test_another_device_at_the_same_path_is_seen() -> None:
    null, zero = look_at("/dev/null"), look_at("/dev/zero")
    assert null.identity is not None
    assert null.identity != zero.identity
    assert look_at("/dev/null") == null


def test_directories_and_fifos_are_there(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    assert look_at(str(tmp_path)) == look_at(str(tmp_path / "fifo"))


def test_a_change_wakes_wherever_it_is(tmp_path: Path) -> None:
    async def scene() -> None:
        path = tmp_path / "dev" / "bus" / "video0"
        watch = Watch()
        try:
            changes: tuple[Callable[[], object], ...] = (
                (tmp_path / "dev").mkdir,
                path.parent.mkdir,
                path.touch,
                partial(path.chmod, 0o400),
                path.unlink,
                path.parent.rmdir,
            )
            for change in changes:
                watch.set_places(watched_places([str(path)]))
                change()
                assert await woken(watch)
        finally:
            watch.close()

    asyncio.run(scene())


def test_use_of_a_file_wakes_nobody(tmp_path: Path) -> None:
    async def scene() -> None:
        file = tmp_path / "null"
        file.touch()
        watch = Watch()
        watch.set_places([str(tmp_path)])
        file.write_text("used")
        file.read_text()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.2):
                await watch.wait(LONG)
        watch.close()

    asyncio.run(scene())


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/dev/null", True),
        ("/dev/no-such-directory/a/b", True),
        ("/dev/fd/0", False),
        ("/tmp/x", False),
        ("/develop", False),
    ],
)
def test_devices(path: str, expected: bool) -> None:
    """/dev/fd is a link to /proc, where inotify reports nothing."""
    assert are_devices([path], watched_places([path])) is expected
    both = [path, "/dev/null"]
    assert are_devices(both, watched_places(both)) is expected


def test_what_is_watched_is_known(tmp_path: Path) -> None:
    async def scene() -> None:
        watch = Watch()
        there, absent = str(tmp_path), str(tmp_path / "absent")
        assert watch.set_places([there, absent]) == {there}
        watch.close()

    asyncio.run(scene())


def test_a_path_at_which_nobody_may_look(tmp_path: Path) -> None:
    """Python 3.11 raises for a name that is too long, as it does without permission."""
    path = f"{tmp_path}/{'x' * 300}/camera"
    assert look_at(path).reason == "not there"
    assert str(tmp_path) in watched_places([path])

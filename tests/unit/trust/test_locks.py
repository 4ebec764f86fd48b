"""The lock file of a dataflow, in a directory that belongs to its nodes' user."""

import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.locks import (
    find_lock,
    open_lock,
    place_of,
    read_reasons,
    take_lock,
    write_reason,
)

NAME = "inhibit.lock"


@pytest.fixture
def lock(tmp_path: Path) -> Iterator[int]:
    """An open lock file."""
    (tmp_path / NAME).touch()
    found = open_lock(tmp_path)
    assert found is not None
    yield found
    os.close(found)


def test_there_is_none(tmp_path: Path) -> None:
    for directory in (tmp_path, tmp_path / "missing"):
        assert find_lock(directory) is None
        assert open_lock(directory) is None


def test_the_caller_may_not_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `doractl inhibit --system` without root: what others see of it stays as it is."""
    (tmp_path / NAME).touch()
    opened = os.open

    def refused(path: str, *how: int, **more: int) -> int:
        if path == NAME:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *how, **more)

    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(DoraSystemdError) as caught:
        open_lock(tmp_path)
    assert caught.value.message == f"cannot use {tmp_path / NAME}: permission denied"
    assert caught.value.hint.startswith("use sudo")
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_which_file_it_is(tmp_path: Path, lock: int) -> None:
    status = (tmp_path / NAME).stat()
    assert find_lock(tmp_path) == place_of(lock) == (status.st_dev, status.st_ino)
    assert not os.get_inheritable(lock)
    assert fcntl.fcntl(lock, fcntl.F_GETFL) & (os.O_RDWR | os.O_APPEND | os.O_NONBLOCK)


@pytest.mark.parametrize(("first", "second"), [(True, True), (True, False), (False, True)])
def test_who_shares_it(tmp_path: Path, lock: int, first: bool, second: bool) -> None:
    other = open_lock(tmp_path)
    assert other is not None
    assert take_lock(tmp_path, lock, first)
    assert take_lock(tmp_path, other, second) is (first and second)
    os.close(other)


def test_the_kernel_cannot_lock(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        take_lock(tmp_path, os.open(tmp_path, os.O_PATH), is_shared=True)
    assert caught.value.message == f"cannot lock {tmp_path / NAME}: Bad file descriptor"
    assert caught.value.hint == "see flock(2) for what this means"


def test_reasons_are_appended_and_the_last_ones_read(lock: int) -> None:
    for number in range(3):
        write_reason(lock, b"%d\n" % number)
    assert read_reasons(lock) == b"0\n1\n2\n"
    write_reason(lock, b"x" * 70_000)
    assert read_reasons(lock) == b"x" * 65_536
    full = os.open("/dev/full", os.O_WRONLY)
    write_reason(full, b"lost")
    os.close(full)


def hard_link(path: Path) -> None:
    (path.parent / "other").touch()
    path.hardlink_to(path.parent / "other")


def link(path: Path) -> None:
    (path.parent / "other").touch()
    path.symlink_to("other")


@pytest.mark.parametrize("make", [hard_link, link, Path.mkdir, os.mkfifo])
@pytest.mark.parametrize("use", [find_lock, open_lock])
def test_what_is_no_lock_file(
    tmp_path: Path, make: Callable[[Path], None], use: Callable[[Path], object]
) -> None:
    make(tmp_path / NAME)
    with pytest.raises(DoraSystemdError) as caught:
        use(tmp_path)
    assert str(tmp_path / NAME) in caught.value.message
    if make is hard_link:
        reason = "it is not, or not only, the lock file of the dataflow"
        assert caught.value.message.endswith(reason)
        assert caught.value.hint == "restart the dataflow: it makes a new one"
        assert caught.value.code is ExitCode.BAD_INPUT


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
@pytest.mark.parametrize("owner", [0, 1000])
def test_a_lock_file_belongs_to_the_owner_of_its_directory(tmp_path: Path, owner: int) -> None:
    os.chown(tmp_path, 1000, -1)
    (tmp_path / NAME).touch()
    os.chown(tmp_path / NAME, owner, -1)
    if owner == 1000:
        assert find_lock(tmp_path) is not None
    else:
        with pytest.raises(DoraSystemdError, match="not, or not only, the lock file"):
            find_lock(tmp_path)

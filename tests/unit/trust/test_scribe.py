"""A file is replaced in one step, with the permissions of its owner, if it is as it was read."""

import os
import stat
import struct
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.owned import replace_file, writer_of
from dora_systemd.trust.paths import Place
from dora_systemd.trust.scribe import replace_text
from tests.unit.trust.test_sight import OTHER, can_run_python

OWN = os.geteuid()
FOREIGN_GROUP = 54321
ACL = "system.posix_acl_access"


@pytest.fixture(params=["own", "other"])
def owner(request: pytest.FixtureRequest) -> int:
    if request.param == "own":
        return OWN
    if not can_run_python(OTHER):
        pytest.skip("only root can write as another user, and if that user can run this Python")
    return OTHER.uid


@pytest.fixture
def place(owner: int) -> Iterator[Path]:
    """A directory of the owner."""
    with TemporaryDirectory(dir="/tmp") as name:
        os.chown(name, owner, -1)
        yield Path(name)


def make(path: Path, data: bytes, owner: int, mode: int = 0o640) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    os.chown(path, owner, OTHER.gid if owner == OTHER.uid else -1)
    return path


def test_a_file_is_replaced(place: Path, owner: int) -> None:
    path = make(place / "ä", b"old", owner)
    replace_file(str(path), b"old", b"new" * 50_000, owner)
    found = path.stat()
    assert path.read_bytes() == b"new" * 50_000
    assert (found.st_uid, found.st_mode & 0o7777) == (owner, 0o640)
    assert [one.name for one in place.iterdir()] == ["ä"]


@pytest.mark.skipif(OWN != 0, reason="only root can give a file any group")
def test_the_group_stays_or_gets_no_more_than_all_users(place: Path, owner: int) -> None:
    """Only root may give a file to a group in which the owner is not."""
    path = make(place / "a", b"old", owner, 0o664)
    os.chown(path, -1, FOREIGN_GROUP)
    replace_file(str(path), b"old", b"new", owner)
    found = path.stat()
    is_kept = found.st_gid == FOREIGN_GROUP
    assert is_kept == (owner == OWN)
    assert found.st_mode & 0o7777 == (0o664 if is_kept else 0o644)


def test_a_file_is_created(place: Path, owner: int) -> None:
    replace_file(f"{place}/new", b"", b"text", owner)
    found = (place / "new").stat()
    assert (found.st_uid, found.st_mode & 0o7777, found.st_size) == (owner, 0o644, 4)


def test_what_has_changed_stays(place: Path, owner: int) -> None:
    path = make(place / "a", b"newer", owner)
    for before in (b"old", b"", b"new"):
        with pytest.raises(DoraSystemdError, match=r"cannot write .*: it was changed meanwhile"):
            replace_file(str(path), before, b"x", owner)
    assert path.read_bytes() == b"newer"
    with pytest.raises(DoraSystemdError, match="No such file"):
        replace_file(f"{place}/gone", b"old", b"x", owner)
    assert [one.name for one in place.iterdir()] == ["a"]


def test_no_link_and_no_device_is_followed(place: Path, owner: int) -> None:
    target = make(place / "target", b"old", owner)
    (place / "link").symlink_to(target)
    os.mkfifo(place / "pipe")
    os.chown(place / "pipe", owner, -1)
    for name, what in (("link", "a symbolic link"), ("pipe", "not a regular file")):
        with pytest.raises(DoraSystemdError, match=f"cannot write .*: it is {what}"):
            replace_file(f"{place}/{name}", b"old", b"x", owner)
    assert target.read_bytes() == b"old"


@pytest.mark.skipif(not can_run_python(OTHER), reason="only root can write as another user")
def test_root_lends_no_permission() -> None:
    """Whatever the user has put in the place of the file, it is that user who writes."""
    with TemporaryDirectory(dir="/tmp") as name:
        os.chown(name, 0, 0)
        Path(name).chmod(0o755)
        path = make(Path(name, "settings"), b"old", 0, 0o644)
        with pytest.raises(DoraSystemdError, match="Permission denied") as caught:
            replace_file(str(path), b"old", b"x", OTHER.uid)
        assert caught.value.code == ExitCode.NO_PERMISSION
        assert path.read_bytes() == b"old"
        with pytest.raises(DoraSystemdError, match="Permission denied"):
            replace_file(f"{name}/new", b"", b"x", OTHER.uid)
        assert [one.name for one in Path(name).iterdir()] == ["settings"]


def test_a_file_that_is_read_only_stays(place: Path, owner: int) -> None:
    path = make(place / "a", b"old", owner, 0o444)
    with pytest.raises(DoraSystemdError, match="it is read-only"):
        replace_file(str(path), b"old", b"new", owner)
    assert path.read_bytes() == b"old"


def test_an_acl_is_kept(place: Path, owner: int) -> None:
    path = make(place / "a", b"old", owner)
    entries = ((1, 6, -1), (2, 4, OTHER.uid), (4, 4, -1), (16, 4, -1), (32, 0, -1))
    acl = struct.pack("<I", 2) + b"".join(struct.pack("<HHi", *one) for one in entries)
    try:
        os.setxattr(path, ACL, acl)
    except OSError:
        pytest.skip("this file system has no ACLs")
    replace_file(str(path), b"old", b"new", owner)
    assert path.read_bytes() == b"new"
    assert os.getxattr(path, ACL) == acl


def test_no_acl_comes_from_the_directory(place: Path, owner: int) -> None:
    path = make(place / "a", b"old", owner, 0o644)
    entries = ((1, 7, -1), (2, 6, OTHER.uid), (4, 5, -1), (16, 7, -1), (32, 5, -1))
    acl = struct.pack("<I", 2) + b"".join(struct.pack("<HHi", *one) for one in entries)
    try:
        os.setxattr(place, "system.posix_acl_default", acl)
    except OSError:
        pytest.skip("this file system has no ACLs")
    replace_file(str(path), b"old", b"new", owner)
    assert (path.read_bytes(), ACL in os.listxattr(path)) == (b"new", False)


def owned_by(*owners: int, shared: str = "") -> Place:
    """The place of a file of root below directories of these users."""
    return Place("/a", 0, stat.S_IFREG | 0o644, frozenset({0, *owners}), shared)


@pytest.mark.skipif(OWN != 0, reason="only root becomes another user")
def test_who_writes_a_file_of_root_in_the_directory_of_a_user() -> None:
    """That user could make the directory a link while root writes."""
    assert writer_of(owned_by()) == 0
    assert writer_of(owned_by(1000)) == 1000
    assert writer_of(owned_by(1000)._replace(uid=1001)) == 1001
    for place in (owned_by(1000, 1001), owned_by(shared="/srv"), owned_by(1000, shared="/srv")):
        with pytest.raises(DoraSystemdError) as caught:
            writer_of(place)
        assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_full_disk_leaves_the_old_file() -> None:
    """/proc takes no new file."""
    with pytest.raises(DoraSystemdError) as caught:
        replace_file("/proc/new", b"", b"x", OWN)
    assert caught.value.code in (ExitCode.FAILURE, ExitCode.NO_PERMISSION)
    with pytest.raises(FileNotFoundError):
        replace_text("/nowhere/new", b"", b"x")

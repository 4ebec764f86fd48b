"""Paths that others may own: whose they are, which links count, and what is read of them."""

import os
import stat
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import Place, exists, firm_part, reached

FILE = stat.S_IFREG | 0o644
IS_ROOT = os.geteuid() == 0
STRANGER, OTHER = 4_000_001, 4_000_002

as_root = pytest.mark.skipif(not IS_ROOT, reason="gives files away")


def place_of(path: Path) -> Place:
    with reached(path) as (_, place):
        return place


def test_reads_a_file_and_tells_its_owner(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"text")
    found = read_file(tmp_path / "a")
    assert found.data == b"text"
    assert found.place.uid == os.getuid()


def test_at_most_so_many_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x" * 1025)
    assert len(read_file(tmp_path / "a", 1025).data) == 1025
    with pytest.raises(DoraSystemdError, match="larger than 1 KiB"):
        read_file(tmp_path / "a", 1024)


@pytest.mark.parametrize("kind", ["fifo", "directory", "device", "socket"])
def test_only_regular_files_and_without_waiting(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    elif kind == "device":
        path = Path("/dev/zero")
    else:
        import socket

        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))
    with pytest.raises(DoraSystemdError, match="it is"):
        read_file(path)


def test_names_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError, match="there is no such file"):
        read_file(tmp_path / "a" / "b")
    assert not exists(tmp_path / "a")
    assert exists(tmp_path)


def test_a_circle_of_links_ends(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(DoraSystemdError, match="symbolic links form a loop"):
        read_file(tmp_path / "a")


def open_files() -> int:
    return len([*Path("/proc/self/fd").iterdir()])


def test_a_long_path_needs_one_descriptor(tmp_path: Path) -> None:
    """With a few of them left, list still reads the node tables; a user's path cannot take all."""
    deep = tmp_path / "/".join("d" * 50)
    deep.mkdir(parents=True)
    (tmp_path / "link").symlink_to(deep)
    before = open_files()
    for path in (deep, tmp_path / "link"):
        with reached(path):
            assert open_files() == before + 1
    firm_part(deep)
    with pytest.raises(FileNotFoundError), reached(deep / "none"):
        pass
    assert open_files() == before


def test_own_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"text")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c").symlink_to(tmp_path / "b")
    assert read_file(tmp_path / "c").data == b"text"


@as_root
def test_a_link_of_somebody_else_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"text")
    (tmp_path / "b").symlink_to("a")
    os.chown(tmp_path / "b", STRANGER, 0, follow_symlinks=False)
    with pytest.raises(
        DoraSystemdError, match="symbolic link that users other than root can change"
    ):
        read_file(tmp_path / "b")


@as_root
@pytest.mark.parametrize("mode", [0o755, 0o1777])
def test_a_link_below_a_directory_of_somebody_else_is_not_followed(
    tmp_path: Path, mode: int
) -> None:
    (tmp_path / "home").mkdir(mode=mode)
    (tmp_path / "a").write_bytes(b"text")
    (tmp_path / "home" / "b").symlink_to(tmp_path / "a")
    os.chown(tmp_path / "home", STRANGER, 0)
    with pytest.raises(DoraSystemdError, match="symbolic link"):
        read_file(tmp_path / "home" / "b")


@as_root
def test_what_is_borrowed_says_so(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    file = tmp_path / "home" / "a"
    file.write_bytes(b"text")
    assert place_of(file).is_roots
    os.chown(tmp_path / "home", STRANGER, 0)
    assert not place_of(file).is_roots
    assert "owns a directory above it" in place_of(file).borrowed
    os.chown(file, STRANGER, 0)
    assert place_of(file).borrowed == ""
    os.chown(file, OTHER, 0)
    assert "owns a directory above it" in place_of(file).borrowed


@as_root
@pytest.mark.parametrize("mode", [0o777, 0o775])
def test_a_directory_of_many_lends_nothing(tmp_path: Path, mode: int) -> None:
    (tmp_path / "many").mkdir()
    file = tmp_path / "many" / "a"
    file.write_bytes(b"text")
    os.chown(tmp_path / "many", STRANGER, STRANGER)
    os.chown(file, STRANGER, STRANGER)
    (tmp_path / "many").chmod(mode)
    assert "users other than its owner can write" in place_of(file).borrowed
    (tmp_path / "many").chmod(0o1777)
    assert place_of(file).borrowed == ""


@pytest.mark.parametrize(
    ("owners", "mode", "shared", "is_roots"),
    [
        ({0}, FILE, "", True),
        ({0, 1}, FILE, "", False),
        ({0}, FILE | 0o020, "", False),
        ({0}, FILE | 0o002, "", False),
        ({0}, FILE, "/tmp", False),
    ],
)
def test_what_is_roots_alone(owners: set[int], mode: int, shared: str, is_roots: bool) -> None:
    assert Place("/x", 0, mode, frozenset(owners), shared).is_roots is is_roots


@as_root
def test_the_part_that_only_root_can_replace(tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "hers/p").mkdir(parents=True)
    for path in (home / "hers", home / "hers/p"):
        os.chown(path, STRANGER, STRANGER)
    (home / "link").symlink_to("hers")
    (home / "deep").symlink_to(home / "hers/p")
    assert firm_part(home / "hers") == str(home / "hers")
    assert firm_part(home / "hers/p") == str(home / "hers")
    assert firm_part(home / "hers/p/none/x") == str(home / "hers")
    assert firm_part(home / "link/p") == str(home / "link"), "root's own link"
    assert firm_part(home / "deep") == str(home), "it leads through what is hers"
    assert firm_part(home / "none/x") == str(home)
    assert firm_part("/") == "/"


@as_root
@pytest.mark.parametrize(
    ("mode", "owner", "is_firm"),
    [
        (0o1777, 0, True),
        (0o1777, STRANGER, False),
        (0o777, 0, False),
        (0o775, 0, False),
        (0o1775, 0, True),
        (0o755, STRANGER, True),
    ],
)
def test_directories_that_others_write(
    tmp_path: Path, mode: int, owner: int, is_firm: bool
) -> None:
    above = tmp_path / "tmp"
    (above / "p").mkdir(parents=True)
    above.chmod(mode)
    os.chown(above / "p", owner, owner)
    assert firm_part(above / "p") == str(above / "p" if is_firm else above)


@as_root
def test_what_is_behind_a_closed_directory_is_not_mounted_by_itself(tmp_path: Path) -> None:
    """Whoever is to see it could have lied about seeing it."""
    for path in (tmp_path, *list(tmp_path.parents)[:-2]):
        path.chmod(0o755)
    closed, group = tmp_path / "closed", 4_000_003
    (closed / "open").mkdir(parents=True)
    (tmp_path / "link").symlink_to("closed/open")
    closed.chmod(0o700)
    assert firm_part(closed / "open", STRANGER) == str(closed)
    assert firm_part(tmp_path / "link", STRANGER) == str(tmp_path)
    assert firm_part(closed / "open") == str(closed / "open"), "root gets anywhere"
    closed.chmod(0o750)
    os.chown(closed, 0, group)
    assert firm_part(closed / "open", STRANGER, [group]) == str(closed / "open")
    assert firm_part(closed / "open", STRANGER, [OTHER]) == str(closed)
    closed.chmod(0o705)
    assert firm_part(closed / "open", STRANGER, [group]) == str(closed), "closed to the group alone"
    assert firm_part(closed / "open", STRANGER) == str(closed / "open")


@as_root
def test_links_without_end_are_not_firm(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("a")
    assert firm_part(tmp_path / "a") == str(tmp_path)

"""Bundles on disk: whole or not there, and read with care."""

import errno
import os
import stat
import tarfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.bundles import store as stores
from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.bundles.store import (
    BLOCK,
    Archive,
    BundleStore,
    Section,
    Sink,
    locked,
    room,
    unwritable,
)
from dora_systemd.decisions.bundles.manifest import MANIFEST, Manifest, format_manifest
from dora_systemd.decisions.views.rows import Bundles, format_bundles
from dora_systemd.errors import DoraSystemdError, ExitCode

AT = 1_767_225_600_000_000
ABOUT = Manifest("robot", "u", "dora-robot.service", "system", "host", AT, "root")


def section(name: str, data: bytes) -> Section:
    return Section(name, lambda sink: sink.write(data))


def write(path: Path, *more: Section, most: int = 1 << 20) -> Archive:
    """A whole bundle."""
    with Archive(path, most, AT) as archive:
        for one in (section("README.txt", b"hello"), section("why.json", b"{}"), *more):
            archive.add(one)
        about = replace(ABOUT, parts=tuple(archive.parts))
        archive.add(section(MANIFEST, format_manifest(about).encode()), reserve=0)
    return archive


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    path = tmp_path / "x.tar"
    write(path, section("journal.export.gz", bytes(range(256)) * 10))
    return path


def test_it_is_a_tar_file_of_its_owner(bundle: Path) -> None:
    assert stat.S_IMODE(bundle.stat().st_mode) == 0o600
    with tarfile.open(bundle) as tar:
        assert [one.name for one in tar] == [
            *("README.txt", "why.json", "journal.export.gz", MANIFEST),
        ]
        first = tar.extractfile("README.txt")
        assert first is not None
        assert first.read() == b"hello"
    with opened(bundle) as found:
        found.check()
        assert found.read("why.json") == b"{}"
        assert found.read("nothing") == b""
        assert found.manifest.name == "robot"


def fail(sink: Sink) -> None:
    sink.write(b"half of it")
    raise DoraSystemdError("cannot read the unit: gone")


def broken(sink: Sink) -> None:
    sink.write(b"half of it")
    raise KeyError("x")


def test_a_section_that_fails_costs_no_other(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    large = section("large", bytes(1 << 20))
    archive = write(
        path, Section("unit.txt", fail), Section("b", broken), large, section("c", b"c")
    )
    assert archive.errors == [
        "unit.txt: cannot read the unit: gone",
        "b: KeyError: 'x'",
        f"large: more than {archive.errors[-1].split()[3]} bytes",
    ]
    with opened(path) as found:
        found.check()
        assert [one.name for one in found.manifest.parts] == ["README.txt", "why.json", "c"]


def test_a_name_that_a_bundle_cannot_have_costs_no_other(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 251}.tar"
    archive = write(path, section("y" * 200, b"y"), section("c", b"c"), section("c", b"d"))
    assert archive.errors == [
        f"{'y' * 200}: ValueError: name is too long",
        "c: there is one of that name",
    ]
    with opened(path) as found:
        found.check()
        assert [one.name for one in found.manifest.parts] == ["README.txt", "why.json", "c"]


def full(_sink: Sink) -> None:
    raise OSError(errno.ENOSPC, "no space")


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no space"):
        write(tmp_path / "x.tar", Section("journal", full))
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_one_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(_sink: Sink) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "x.tar", Section("journal", interrupt))
    assert list(tmp_path.iterdir()) == []


def trouble(path: Path) -> str:
    with pytest.raises(DoraSystemdError) as caught, opened(path) as found:
        found.check()
    assert caught.value.code is ExitCode.BAD_INPUT
    assert "\n" not in caught.value.message
    return caught.value.message


def test_one_that_was_cut(bundle: Path) -> None:
    data = bundle.read_bytes()
    for size in range(BLOCK, len(data) - BLOCK, 317):
        bundle.write_bytes(data[:size])
        assert "it was cut" in trouble(bundle), size


def test_one_that_was_changed(bundle: Path) -> None:
    data = bytearray(bundle.read_bytes())
    data[BLOCK] ^= 1
    bundle.write_bytes(data)
    assert trouble(bundle).endswith("it was changed: README.txt is not what was written")


def test_one_with_another_file(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    with Archive(path, 1 << 20, AT) as archive:
        archive.add(section("README.txt", b"x"))
        archive.add(section(MANIFEST, format_manifest(ABOUT).encode()))
    assert "its files are not those of its manifest.json" in trouble(path)


def foreign(kind: bytes, name: str = "README.txt") -> bytes:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, "/etc/shadow" if kind == tarfile.SYMTYPE else ""
    return info.tobuf(tarfile.USTAR_FORMAT)


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"x", bytes(4096), b"\x1f\x8b" + bytes(2000), os.urandom(4096)),
        foreign(tarfile.SYMTYPE),
        foreign(tarfile.DIRTYPE),
        foreign(tarfile.REGTYPE, "other.txt"),
        foreign(tarfile.REGTYPE) + foreign(tarfile.REGTYPE, "../x"),
        foreign(tarfile.REGTYPE) + foreign(tarfile.LNKTYPE, "why.json"),
        foreign(tarfile.REGTYPE) * 2,
        foreign(tarfile.REGTYPE) + foreign(tarfile.GNUTYPE_SPARSE, "why.json"),
        foreign(tarfile.REGTYPE) + b"".join(foreign(tarfile.REGTYPE, f"x{n}") for n in range(600)),
    ],
)
def test_foreign_files(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x.tar"
    path.write_bytes(data)
    assert "as a bundle" in trouble(path)


def test_what_is_no_file(tmp_path: Path) -> None:
    assert "no such file" in trouble(tmp_path / "nothing")
    assert "directory" in trouble(tmp_path)
    os.mkfifo(tmp_path / "fifo")
    assert "not a regular file" in trouble(tmp_path / "fifo")


@pytest.fixture
def store(tmp_path: Path) -> BundleStore:
    return BundleStore(tmp_path, "robot")


def test_the_store(store: BundleStore) -> None:
    assert store.known() == []
    with locked(store):
        names = []
        for stamp in ("20260101T000001Z", "20260101T000000Z", "20260101T000001Z"):
            path = store.new_path(stamp, "requested")
            write(path)
            names.append(path.name)
        (store.path / ".x.partial").touch()
        (store.path / "notes.txt").touch()
        store.remove_partial()
    assert names[0] != names[2]
    assert [one.id for one in store.known()] == [names[1], names[0], names[2]]
    assert {one.event for one in store.known()} == {"requested"}
    for place in (store.path, store.root):
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
    with pytest.raises(DoraSystemdError, match="robot has no bundle x"):
        store.remove([names[0], "x"])
    assert len(store.known()) == 3
    store.remove(names)
    assert store.known() == []
    assert [path.name for path in store.path.iterdir()] == ["notes.txt"]


def test_what_failures_have_left(store: BundleStore) -> None:
    assert store.of_failures() == Bundles()
    with locked(store):
        for event in ("failed", "node-given-up", "requested"):
            write(store.new_path("20260101T000000Z", event))
        store.add_refused("too soon", AT)
        store.add_refused("it is full", AT + 5)
        store.remove_partial()
    newest = store.path / "robot-20260101T000000Z.1-node-given-up.tar"
    found = Bundles(2, str(newest), AT, 2, AT + 5, "it is full")
    assert store.of_failures() == found
    assert format_bundles(found) == f"{newest} and 1 more; 2 not written, the last: it is full"
    (store.path / ".refused").write_text("[5")
    assert store.of_failures() == Bundles(2, str(newest), AT)
    store.remove([one.id for one in store.known()])
    assert not store.path.exists()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The free blocks of a disk of 1,000 blocks of 1 MiB."""
    free = [900]

    def answer(_path: object) -> os.statvfs_result:
        values = (1 << 20, 1 << 20, 1000, free[0], free[0], 1, 1, 1, 0, 255)
        return os.statvfs_result(values)

    monkeypatch.setattr(os, "statvfs", answer)
    yield free


def test_a_bundle_leaves_some_of_the_disk(disk: list[int], tmp_path: Path) -> None:
    assert room(tmp_path) == 750 << 20
    disk[0] = 151
    assert room(tmp_path) == 1 << 20
    disk[0] = 150
    with pytest.raises(DoraSystemdError, match="only 150M of the disk free") as caught:
        room(tmp_path)
    assert caught.value.hint == "a bundle leaves 150M free; see df"


@pytest.mark.parametrize(
    ("number", "code", "hint"),
    [
        (errno.ENOENT, ExitCode.BAD_INPUT, "create that directory first"),
        (errno.ENOTDIR, ExitCode.BAD_INPUT, "name a file in a directory"),
        (errno.ENAMETOOLONG, ExitCode.BAD_INPUT, "name a file with a shorter name"),
        (errno.EROFS, ExitCode.FAILURE, "-o FILE in a directory of your own"),
        (errno.ENOSPC, ExitCode.FAILURE, "see df"),
        (errno.EACCES, ExitCode.NO_PERMISSION, "-o FILE" if os.geteuid() == 0 else "use sudo, or"),
    ],
)
def test_what_to_do_where_none_can_be_written(number: int, code: ExitCode, hint: str) -> None:
    found = unwritable(Path("/x/y.tar"), OSError(number, os.strerror(number)))
    assert found.message == f"cannot write a bundle to /x/y.tar: {os.strerror(number)}"
    assert found.code is code
    assert found.hint.startswith(hint)


def test_a_file_system_that_reports_no_size_has_room() -> None:
    assert room(Path("/proc")) > 1 << 40


def test_what_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "dora-systemd").touch()
    with pytest.raises(DoraSystemdError, match="cannot use"), locked(BundleStore(tmp_path, "a")):
        pass
    error = PermissionError(errno.EACCES, "Permission denied")
    refused = stores.unusable(Path("/var/lib/dora-systemd/bundles"), error)
    hint = "use sudo, or --user for a dataflow of your own"
    assert (refused.code, refused.hint) == (ExitCode.NO_PERMISSION, hint)
    assert stores.unusable(Path("/var/x"), error, ", or -o FILE").hint == f"{hint}, or -o FILE"
    assert stores.unusable(Path("/home/joe/.local/state"), error).hint.startswith("HOME is "), (
        "sudo would search the bundles of the system, which are others"
    )

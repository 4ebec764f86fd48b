"""The store of releases: a release is there as a whole or not at all."""

import contextlib
import fcntl
import os
import resource
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import (
    Store,
    is_locked,
    locked,
    remove_tree,
    store_root,
)
from dora_systemd.adapters.releases.transfer import Spool, spooled
from dora_systemd.decisions.releases.manifest import Manifest, Stored
from dora_systemd.decisions.releases.past import Known
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope

ONE, TWO = "20261121T220012", "20261122T220012"


def manifest(release: str, files: dict[str, Stored]) -> Manifest:
    return Manifest(release, "robot", "u", "d.yml", "/srv", "", "", 1, files=files)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    found = Store(tmp_path / "state" / "releases", "robot")
    with locked(found):
        found.path.joinpath("notes").mkdir()  # as of somebody else; an empty store would go
    return found


def written(store: Store, release: str) -> Manifest:
    """A release with a file in a directory, and a link."""
    draft = Draft(store)
    files = {"d/a.py": draft.write("d/a.py", [b"ab", b"c"], True), "l": draft.link("l", "d/a.py")}
    draft.publish(manifest(release, files), None)
    draft.discard()
    return store.manifest(release)


def test_a_release(store: Store) -> None:
    assert store.known() == []
    one = written(store, ONE)
    assert one.files["d/a.py"].size == 3
    path = store.tree(ONE) / "d/a.py"
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("abc", 0o555)
    assert (store.tree(ONE) / "l").read_text() == "abc"
    assert store.tree(ONE).stat().st_mode & 0o222 == 0
    assert store.known() == [Known(ONE, False)]
    assert store.unfinished() == [store.release(ONE)]
    store.write_unit(ONE, "text")
    store.prove(ONE)
    assert store.unit(ONE) == "text"
    assert store.known() == [Known(ONE, True)]
    assert store.unfinished() == []


def test_what_is_shared_survives_the_first_owner(store: Store) -> None:
    written(store, ONE)
    draft = Draft(store)
    with draft.reading_ahead(ONE, ["d/a.py"]):
        assert draft.share("d/a.py", ONE, store.manifest(ONE).files["d/a.py"])
    draft.publish(manifest(TWO, {}), None)
    shared = store.tree(TWO) / "d/a.py"
    assert shared.stat().st_nlink == 2
    store.remove(ONE)
    assert shared.read_text() == "abc"
    assert [one.id for one in store.known()] == [TWO]
    store.remove(ONE)  # as by two at once


@pytest.mark.parametrize("ahead", [[], ["d/a.py"]], ids=["now", "ahead"])
@pytest.mark.parametrize("data", ["abd", "", None])
def test_what_has_changed_on_the_disk_is_not_shared(
    store: Store, data: str | None, ahead: list[str]
) -> None:
    """Same name, size and time, and another content; or a file that is gone."""
    one = written(store, ONE)
    path = store.tree(ONE) / "d/a.py"
    before = path.stat()
    if data is None:
        path.unlink()
    else:
        path.chmod(0o755)
        path.write_text(data)
        path.chmod(0o555)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    draft = Draft(store)
    with draft.reading_ahead(ONE, ahead):
        assert not draft.share("d/a.py", ONE, one.files["d/a.py"])
    assert draft.damaged == ["d/a.py"]
    assert not (draft.tree / "d/a.py").exists()
    draft.discard()


def test_an_unfinished_one_is_no_release(store: Store) -> None:
    draft = Draft(store)
    draft.write("a", [b"x"], False)
    assert store.known() == []
    (left,) = store.unfinished()
    assert left.stat().st_mode & 0o777 == 0o700  # others may not read what it copies
    remove_tree(left)
    assert store.unfinished() == []


def test_a_draft_stays_in_its_directory(store: Store) -> None:
    draft = Draft(store)
    draft.link("d", "/tmp")
    with pytest.raises(FileExistsError):
        draft.write("d", [b""], False)
    draft.discard()


def test_one_at_a_time(store: Store) -> None:
    with locked(store), pytest.raises(DoraSystemdError, match="another deploy"), locked(store):
        pass
    with locked(store):
        pass


def test_nobody_else_can_take_the_lock(store: Store) -> None:
    (store.path / "release").touch()
    held = os.open(store.path, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)  # the directory, which all users may open
    with locked(store):
        assert store.lock.stat().st_mode & 0o777 == 0o600
    os.close(held)
    store.lock.unlink()
    store.lock.symlink_to(store.path / "elsewhere")
    with pytest.raises(DoraSystemdError, match="cannot use"), locked(store):
        pass
    assert not (store.path / "elsewhere").exists()


def test_a_store_without_a_release_goes(tmp_path: Path) -> None:
    store = Store(tmp_path, "robot")
    with locked(store):
        assert store.path.exists()
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_is_not_there(tmp_path: Path) -> None:
    store = Store(tmp_path, "robot")
    assert store.known() == []
    with pytest.raises(DoraSystemdError, match="cannot use"), locked(store, make=False):
        pass
    with pytest.raises(DoraSystemdError, match="cannot read"):
        store.manifest(ONE)


@pytest.mark.parametrize("name", ["release.json", "unit"])
def test_a_lost_file_of_a_release_says_what_to_do_instead(store: Store, name: str) -> None:
    """Nobody has given its path, so there is no path to correct."""
    written(store, ONE)
    (store.release(ONE) / name).unlink(missing_ok=True)
    with pytest.raises(DoraSystemdError, match=f"{ONE}/{name}: there is no such file") as caught:
        (store.manifest if name == "release.json" else store.unit)(ONE)
    hint = "deploy again, or choose another release: doractl releases robot"
    assert caught.value.hint == hint


@pytest.mark.parametrize(
    ("is_user", "state", "place"),
    [
        (False, "/y", "/var/lib"),
        (True, "", "/x/.local/state"),
        (True, "/y", "/y"),
        (True, "relative", "/x/.local/state"),
    ],
)
def test_where_it_is(
    is_user: bool, state: str, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/x")
    monkeypatch.setenv("XDG_STATE_HOME", state)
    found = store_root(Scope(is_user, 1000).state_root)
    assert found == Path(place, "dora-systemd/releases")


def test_whether_somebody_changes_a_store(tmp_path: Path) -> None:
    store = Store(tmp_path, "robot")
    assert not is_locked(store)
    with locked(store):
        assert is_locked(store)
        (store.path / ".build-1").mkdir()
    assert not is_locked(store)


def test_what_is_removed_follows_no_link_and_may_be_deep(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir(mode=0o750)
    place = tmp_path / "tree"
    place.mkdir()
    (place / "link").symlink_to(kept)
    with contextlib.chdir(place):
        for _ in range(3000):
            Path("ddd").mkdir()
            os.chdir("ddd")
    (place / "closed").mkdir(mode=0)
    remove_tree(place)
    assert not place.exists()
    assert kept.stat().st_mode & 0o777 == 0o750


def test_a_disk_that_takes_half_a_file_is_an_error(store: Store) -> None:
    """What is written last may be taken in part, without an error of its own."""
    draft, limits = Draft(store), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            draft.write("a", [b"x" * 2000], is_executable=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        draft.discard()


def test_only_errors_of_the_spool_name_its_directory(tmp_path: Path) -> None:
    with pytest.raises(BrokenPipeError), spooled():
        raise BrokenPipeError  # as of standard output
    full = os.open("/dev/full", os.O_WRONLY)
    with contextlib.closing(os.fdopen(full, "wb")), pytest.raises(DoraSystemdError) as refused:
        Spool(full, tmp_path).write("", [b"x"], is_executable=False)
    assert refused.value.message == f"cannot use {tmp_path}: No space left on device"

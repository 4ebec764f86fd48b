"""A project that another host sends: what of it is written, and where."""

import errno
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store
from dora_systemd.adapters.releases.transfer import Stream, incoming, leftovers, spooled
from dora_systemd.decisions.releases.manifest import Manifest, Stored
from dora_systemd.decisions.releases.parcel import Parcel, format_parcel
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases import receive
from dora_systemd.verbs.releases.deploy import DeployRequest
from dora_systemd.verbs.releases.receive import (
    Known,
    _fill,
    _renamed,
    _require_space,
    _require_user,
    _source,
)
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.deploys import FLOW
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import NEW as NEW_ID
from tests.unit.verbs.releases.test_trial import store

__all__ = ["store"]


def stream_of(data: bytes) -> Stream:
    read, write = os.pipe()
    os.write(write, data)
    os.close(write)
    return Stream(read)


def stored(data: bytes, is_executable: bool = False) -> Stored:
    with spooled() as spool:
        return spool.write("", [data], is_executable)


OLD, NEW = stored(b"old"), stored(b"newer")
FILES = {
    "dataflow.yml": OLD,
    "moved.yml": OLD,
    "bin/run": stored(b"newer", True),
    "copy": NEW,
    "link": Stored(target="bin/run"),
}
PARCEL = Parcel("robot", "/srv/robot", "dataflow.yml", None, "", FILES)


def test_what_is_here_already_is_shared(tmp_path: Path) -> None:
    tree = tmp_path / "last"
    tree.mkdir()
    (tree / "dataflow.yml").write_text("old")
    with incoming(tmp_path) as draft:
        known = Known(tree, {"dataflow.yml": OLD})
        _fill(stream_of(b"newer"), PARCEL, [1], draft, known, lambda _: None)
        found = {path: (draft.tree / path).read_text() for path in FILES}
        assert found == {path: "old" if one == OLD else "newer" for path, one in FILES.items()}
        assert (draft.tree / "dataflow.yml").samefile(tree / "dataflow.yml")
        assert [os.access(draft.tree / one, os.X_OK) for one in ("bin/run", "copy")] == [
            True,
            False,
        ]
        assert (draft.tree / "link").readlink() == Path("bin/run")
    assert [one.name for one in tmp_path.iterdir()] == ["last"]


def test_what_a_build_has_made_is_not_removed(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    """A dry run compares projects, as one without -H."""
    files = {"gone": OLD, "copy": OLD, ".venv/pyvenv.cfg": replace(NEW, is_built=True)}
    store.release(NEW_ID).rmdir()
    last = Manifest(NEW_ID, "robot", "u", "dataflow.yml", "/srv", "", "", 1, files=files)
    Draft(store).publish(last, None)
    parcel = Parcel("robot", "", "copy", None, "", {"copy": NEW})
    found = receive.compare_sent(manager, scope, stream_of(format_parcel(parcel)))
    assert found == (NEW_ID, {"added": [], "changed": ["copy"], "removed": ["gone"]})


@pytest.mark.parametrize("data", [b"", b"new", b"other"])
def test_what_is_not_what_was_announced(data: bytes, tmp_path: Path) -> None:
    parcel = Parcel("robot", "", "copy", None, "", {"copy": NEW})
    with pytest.raises(DoraSystemdError), incoming(tmp_path) as draft:
        _fill(stream_of(data), parcel, [0], draft, Known(tmp_path, {}), lambda _: None)
    assert not [*tmp_path.iterdir()]


def test_a_file_here_that_changes_after_it_was_compared(tmp_path: Path) -> None:
    """A copy of it would be released under the digest of what it was."""
    (tmp_path / "dataflow.yml").write_text("odd")
    parcel = Parcel("robot", "", "copy", None, "", {"copy": OLD})
    known = Known(tmp_path, {"dataflow.yml": OLD})
    with (
        pytest.raises(DoraSystemdError, match="cannot receive copy: it is not what was announced"),
        incoming(tmp_path) as draft,
    ):
        _fill(stream_of(b""), parcel, [], draft, known, lambda _: None)


@pytest.mark.parametrize(
    "read",
    [
        lambda stream: stream.line(10),
        lambda stream: stream.line(2),
        lambda stream: b"".join(stream.chunks(9)),
    ],
)
def test_a_stream_that_ends(read: Callable[[Stream], bytes]) -> None:
    with pytest.raises(DoraSystemdError, match="cannot read a project from standard input"):
        read(stream_of(b"12345"))


def test_a_stream() -> None:
    stream = stream_of(b"head\nbody")
    assert (stream.line(10), b"".join(stream.chunks(3))) == (b"head", b"bod")
    is_over, end = os.pipe()
    assert stream.wait_for_end(is_over)
    os.write(end, b".")
    assert not Stream(os.open("/dev/zero", os.O_RDONLY)).wait_for_end(is_over)


def test_nobody_sends_any_more() -> None:
    read, write = os.pipe()
    with pytest.raises(DoraSystemdError, match="no more of it came"):
        Stream(read, 0.0).line(10)
    os.close(write)


def test_another_sender_ends_while_this_one_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It removes the directory that both share."""

    change_mode = Path.chmod

    def end(path: Path, mode: int) -> None:
        change_mode(path, mode)
        path.rmdir()
        monkeypatch.undo()

    monkeypatch.setattr(Path, "chmod", end)
    with incoming(tmp_path) as draft:
        assert draft.tree.is_dir()
        assert (tmp_path / ".sent").stat().st_mode & 0o777 == 0o711
    assert not [*tmp_path.iterdir()]


def test_what_a_killed_one_has_left(tmp_path: Path) -> None:
    """It goes, unless somebody is still at it."""
    with incoming(tmp_path) as other:
        left = Draft(other._store)
        assert leftovers(tmp_path) == []
        for one in (left, other):
            os.utime(one.tree.parent, (0, 0))
        assert leftovers(tmp_path) == [left.tree.parent]
        with incoming(tmp_path):
            assert not left.tree.exists()
            assert other.tree.exists()


ROOTS, USERS = Scope(is_user=False, uid=0), Scope(is_user=True, uid=1000)


@pytest.mark.parametrize(
    ("scope", "owner", "user", "is_given", "is_refused"),
    [
        (ROOTS, "ann", "dora", False, True),
        (ROOTS, "ann", "dora", True, False),
        (ROOTS, "", "dora", False, False),
        (ROOTS, "ann", "", False, False),
        (USERS, "ann", "dora", False, False),
    ],
)
def test_whose_code_runs_as_the_user_of_all(
    scope: Scope, owner: str, user: str, is_given: bool, is_refused: bool
) -> None:
    """A project of another user that root sends: only if root names a user for it."""
    plan = SimpleNamespace(
        user=SimpleNamespace(pw_name=user) if user else None,
        settings=SimpleNamespace(is_given=lambda _: is_given),
    )
    source: Any = SimpleNamespace(plan=plan)
    parcel = replace(PARCEL, owner=owner)
    if not is_refused:
        _require_user(scope, parcel, source)
        return
    with pytest.raises(DoraSystemdError) as caught:
        _require_user(scope, parcel, source)
    error = caught.value
    assert error.message == (
        "cannot deploy robot: ann owns it where it comes from, "
        "and here it would run as dora, like root's dataflows"
    )
    assert error.hint == "name the user here that it is to run as: --uid USER, such as --uid dora"
    assert error.code is ExitCode.NO_PERMISSION


def test_the_settings_of_a_project_count_before_anybody_may_read_it(tmp_path: Path) -> None:
    """They say whose it is: here a user that no dataflow of a user can have."""
    (tmp_path / "dataflow.yml").write_text(FLOW)
    (tmp_path / "dataflow.systemd.yml").write_text("user: nobody\n")
    lent: list[int | None] = []
    draft = cast(Draft, SimpleNamespace(tree=tmp_path, lend=lent.append))
    request = DeployRequest(StartRequest("", flags={"dora": "/nowhere/dora"}), 0, 3, True)
    with pytest.raises(DoraSystemdError, match="cannot choose the user of a dataflow with --user"):
        _source(Scope(is_user=True, uid=os.geteuid()), request, PARCEL, draft)
    assert lent == []


def test_warnings_name_the_project_as_its_sender_does() -> None:
    heard: list[str] = []
    _renamed(heard.append, "/var/x/.sent/1", "/home/ann/robot")("cannot read /var/x/.sent/1/a.py")
    assert heard == ["cannot read /home/ann/robot/a.py"]


@pytest.mark.parametrize(("free", "fits"), [(8, True), (7, False)])
def test_a_disk_without_room_for_what_is_to_come(free: int, fits: bool) -> None:
    """Nothing is asked for then."""
    draft: Any = SimpleNamespace(free_bytes=lambda: free)
    if fits:
        _require_space(draft, PARCEL, [0, 1])
        return
    with pytest.raises(OSError, match="No space left on device") as caught:
        _require_space(draft, PARCEL, [0, 1])
    assert caught.value.errno == errno.ENOSPC

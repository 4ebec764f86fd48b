"""Which files of a project are copied, and that none is copied in half."""

import os
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.manifest import Found, Manifest, Stored
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.verbs.releases.files import copy_files, digests, find_files

FIRST = "20261121T220012"
PLACES = ("a.py", "models/m.onnx", "target/release/node", ".venv/x", "__pycache__/a.pyc", "x.log")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "project"
    for place in PLACES:
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_text(place)
    return root


@pytest.fixture
def project(root: Path) -> Iterator[Project]:
    with opened_project(str(root), None) as found:
        yield found


@pytest.fixture
def store(tmp_path: Path) -> Store:
    found = Store(tmp_path / "store", "robot")
    found.path.mkdir(parents=True)
    return found


def test_without_git_all_but_rubbish(root: Path, project: Project) -> None:
    assert set(find_files(project, [], [])[0]) == {*PLACES[:3]}
    (root / ".gitignore").write_text("models/\n")
    assert set(find_files(project, [], [])[0]) == {".gitignore", "a.py", "target/release/node"}


def test_what_is_named_behind_a_link_is_where_the_link_leads(root: Path, project: Project) -> None:
    (root / "v2").mkdir()
    (root / "v2/node.py").write_text("x")
    (root / "current").symlink_to("latest")
    (root / "latest").symlink_to("v2")
    (root / "circle").symlink_to("circle")
    found, _ = find_files(project, ["current/node.py", "circle/node.py"], [])
    assert {"current", "latest", "v2/node.py"} < set(found)
    assert not {"current/node.py", "circle/node.py"} & set(found)


def test_what_the_dataflow_names_belongs_to_it(root: Path, project: Project) -> None:
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    (root / ".gitignore").write_text("target/\n*.log\n.venv\n__pycache__\n")
    found, revision = find_files(project, ["target/release/node", "not/there"], [])
    assert set(found) == {".gitignore", "a.py", "models/m.onnx", "target/release/node"}
    assert revision == ""


def test_a_repository_in_the_repository(root: Path, project: Project) -> None:
    for directory in (root, root / "models"):
        subprocess.run(["git", "init", "-q"], cwd=directory, check=True)
    assert "models/m.onnx" in find_files(project, [], [])[0]


class Many:
    """A project whose git, or without it whose only directory, has a million files."""

    root = "/srv/many"

    def __init__(self, has_git: bool) -> None:
        self._has_git = has_git
        self.asked = 0

    def tracked(self, _owners: object, most: int) -> tuple[list[str] | None, str]:
        return [str(number) for number in range(1_000_000)[:most]] if self._has_git else None, ""

    def walked(self, _directory: str, most: int, _always: object) -> list[list[object]]:
        self.asked += 1
        return [[str(one), "file", 1, False, "", ""] for one in range(1_000_000)[:most]]

    def facts(self, _paths: object) -> list[None]:
        raise AssertionError("nobody looks for each of them")


@pytest.mark.parametrize("has_git", [True, False])
def test_a_million_files_are_refused_early(has_git: bool) -> None:
    many = Many(has_git)
    with pytest.raises(DoraSystemdError, match="more than 100000 files"):
        find_files(many, [], [])  # type: ignore[arg-type]
    assert many.asked == (0 if has_git else 1)


def copied(project: Project, store: Store, found: dict[str, Found]) -> dict[str, Stored]:
    """A release of these files, and what is in it."""
    last = store.manifest(FIRST) if store.known() else None
    draft = Draft(store)
    stored = copy_files(project, found, draft, last, lambda _done, _total: None)
    name = FIRST if last is None else "20261122T220012"
    draft.publish(Manifest(name, "robot", "", "", "", "", "", 1, files=stored), None)
    return stored


def test_copies_share_what_is_the_same(root: Path, project: Project, store: Store) -> None:
    found, _ = find_files(project, [], [])
    first = copied(project, store, found)
    assert first == dict(digests(project, found, {}))
    (root / "a.py").write_text("else")
    second = copied(project, store, find_files(project, [], [])[0])
    assert {one for one in first if first[one] != second[one]} == {"a.py"}
    links = {path: (store.tree(FIRST) / path).stat().st_nlink for path in first}
    assert links == {"a.py": 1, "models/m.onnx": 2, "target/release/node": 2}


class Reads:
    """A project, and the bytes of its files that are read."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self.size = 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._project, name)

    def read(self, path: str) -> Iterator[bytes]:
        for chunk in self._project.read(path):
            self.size += len(chunk)
            yield chunk


def aged(found: dict[str, Found], stored: dict[str, Stored]) -> dict[str, Stored]:
    """What a release would have of these files if they were older than a minute."""
    return {path: replace(one, seen=found[path].seen) for path, one in stored.items()}


def test_files_that_have_not_changed_are_not_read(
    root: Path, project: Project, store: Store
) -> None:
    found, _ = find_files(project, [], [])
    first = copied(project, store, found)
    assert not any(one.seen for one in first.values()), "they are young"
    manifest = store.manifest(FIRST)
    store.write_manifest(replace(manifest, files=aged(found, first)))
    known = store.manifest(FIRST).files
    assert [one.seen for one in known.values()] == [one.seen for one in found.values()]
    text = (root / "a.py").read_text()
    (root / "a.py").write_text(text.upper())
    os.utime(root / "a.py", ns=(1, (root / "models/m.onnx").stat().st_mtime_ns))
    now, _ = find_files(project, [], [])
    reads = Reads(project)
    compared = dict(digests(reads, now, known))  # type: ignore[arg-type]
    assert {path for path, one in compared.items() if one != known[path]} == {"a.py"}
    assert reads.size == len(text)
    second = copied(reads, store, now)  # type: ignore[arg-type]
    assert second == dict(digests(project, now, {}))
    assert reads.size == 3 * len(text), "compared, and copied"
    assert store.intact(store.manifest("20261122T220012")) == second


def test_an_owner_who_lies_gets_the_former_content(
    root: Path, project: Project, store: Store
) -> None:
    first = copied(project, store, find_files(project, [], [])[0])
    (root / "a.py").write_text("y.pa")
    found, _ = find_files(project, [], [])
    known = aged(found, first)
    assert dict(digests(project, found, known)) == first


def test_a_change_after_the_search_is_read(root: Path, project: Project, store: Store) -> None:
    found, _ = find_files(project, [], [])
    first = copied(project, store, found)
    before = (root / "a.py").stat()
    (root / "a.py").write_text("y" * before.st_size)
    os.utime(root / "a.py", ns=(before.st_atime_ns, before.st_mtime_ns))
    now = dict(digests(project, found, aged(found, first)))
    assert {path for path, one in now.items() if one != first[path]} == {"a.py"}


@pytest.mark.usefixtures("root")
def test_copies_heal_what_the_disk_has_damaged(project: Project, store: Store) -> None:
    found, _ = find_files(project, [], [])
    copied(project, store, found)
    damaged = store.tree(FIRST) / "models/m.onnx"
    damaged.chmod(0o600)
    damaged.write_text("models/m.onny")
    second = copied(project, store, found)
    assert second == dict(digests(project, found, {}))
    assert store.intact(store.manifest("20261122T220012")) == second


@pytest.mark.parametrize("text", ["longer than before", "", "b.py"])
def test_a_file_that_changes_meanwhile(
    root: Path, project: Project, store: Store, text: str
) -> None:
    found, _ = find_files(project, [], [])
    (root / "a.py").write_text(text)
    with pytest.raises(DoraSystemdError, match=r"cannot copy a\.py: it changed"):
        copied(project, store, found)
    assert store.known() == []


def test_what_git_has_not_brought_is_refused_by_name(root: Path, project: Project) -> None:
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 70000000\n"
    (root / "models/m.onnx").write_text(pointer)
    with pytest.raises(DoraSystemdError, match=r"models/m\.onnx: it is a pointer of Git LFS") as e:
        copied_all(project, root)
    assert "git lfs pull" in e.value.hint
    (root / "models/m.onnx").write_text(f"read {pointer}")
    copied_all(project, root)


def test_a_submodule_that_is_not_there_is_refused(root: Path) -> None:
    def git(*words: str, at: Path = root) -> None:
        name = ("-c", "user.name=a", "-c", "user.email=a", "-c", "protocol.file.allow=always")
        subprocess.run(["git", "-C", str(at), *name, *words], check=True, capture_output=True)

    library = root.parent / "library"
    library.mkdir()
    for place in (library, root):
        git("init", "-q", at=place)
    (library / "x.py").write_text("x")
    git("add", ".", at=library)
    git("commit", "-qm", "x", at=library)
    git("submodule", "add", str(library), "lib")
    owners = [root.stat().st_uid]
    with opened_project(str(root), None) as project:
        assert "lib/x.py" in find_files(project, [], owners)[0]
    git("submodule", "deinit", "-f", "lib")
    with (
        opened_project(str(root), None) as project,
        pytest.raises(DoraSystemdError, match="cannot copy lib: it is a repository of git") as e,
    ):
        find_files(project, [], owners)
    assert "git submodule update" in e.value.hint


def copied_all(project: Project, root: Path) -> None:
    """Copy the project into a store of its own."""
    store = Store(root.parent / "other", "robot")
    store.path.mkdir(parents=True, exist_ok=True)
    copy_files(project, find_files(project, [], [])[0], Draft(store), None, lambda *_: None)

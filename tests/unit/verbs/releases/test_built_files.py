"""What of a built tree belongs to a release, and what none can have."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.verbs.releases.build import find_built

TREE = Path("/var/lib/dora-systemd/releases/robot/20260101T000000/tree")
FILES = ("a.py", "built/x.log", "target/CACHEDIR.TAG", "target/release/node", "target/note")
PROGRAMS = ("target/release/node", "target/release/deps/node-1")
LEFT_OUT = (".git/config", "__pycache__/a.pyc", "target/release/deps/node-1", "empty/.git/x")
OF_VENV = (".venv/pyvenv.cfg", ".venv/CACHEDIR.TAG", ".venv/lib/__pycache__/a.pyc")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for place in {*FILES, *PROGRAMS, *LEFT_OUT, *OF_VENV}:
        path = tmp_path / "tree" / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(place)
        path.chmod(0o755 if place in PROGRAMS else 0o644)
    (tmp_path / "tree/.venv/bin").mkdir()
    return tmp_path / "tree"


@pytest.fixture
def project(root: Path) -> Iterator[Project]:
    with opened_project("/srv/robot", None, str(root)) as found:
        yield found


def found_in(project: Project, named: tuple[str, ...] = (), is_user: bool = False) -> set[str]:
    return set(find_built(project, named, TREE, is_user))


def test_caches_and_repositories_are_left_out(project: Project) -> None:
    plain = {"a.py", "built/x.log", "target/release/node", *OF_VENV}
    assert found_in(project) == plain
    assert found_in(project, ("target/note", "not/there")) == {*plain, "target/note"}


def test_the_interpreter_of_a_virtual_environment(root: Path, project: Project) -> None:
    link = root / ".venv/bin/python3"
    link.symlink_to("/bin/sh")  # root's, as /usr/bin/python3 is
    assert ".venv/bin/python3" in found_in(project)
    link.unlink()
    own = root.parent / "python3"
    own.write_text("")
    own.chmod(0o777)
    link.symlink_to(own)
    with pytest.raises(DoraSystemdError, match="others than root can change"):
        found_in(project)
    assert ".venv/bin/python3" in found_in(project, is_user=True)
    link.unlink()
    (root / ".venv/bin/other").symlink_to("/bin/sh")
    with pytest.raises(DoraSystemdError, match="outside of every release"):
        found_in(project, is_user=True)


@pytest.mark.parametrize("target", ["/", "/usr/bin", "/dev/null", "/proc/self/exe"])
def test_no_way_out_by_a_link_that_looks_like_an_interpreter(
    root: Path, project: Project, target: str
) -> None:
    """Behind a directory there may be a link of anybody, which is read as root's later."""
    (root / ".venv/bin/python-x").symlink_to(target)
    with pytest.raises(DoraSystemdError, match="others than root can change"):
        found_in(project)


def test_a_link_to_the_whole_tree(root: Path, project: Project) -> None:
    (root / "here").symlink_to(f"{TREE}/")
    assert "here" in found_in(project)


def test_links_by_the_path_of_the_release(root: Path, project: Project) -> None:
    (root / "built/link").symlink_to(TREE / "a.py")
    assert "built/link" in found_in(project)
    (root / "built/link").unlink()
    (root / "built/link").symlink_to(f"{TREE}/built/../../../x")
    with pytest.raises(DoraSystemdError, match="outside of every release"):
        found_in(project)


def test_a_named_file_behind_a_link(root: Path, project: Project) -> None:
    (root / "behind").symlink_to("built")
    found = found_in(project, ("behind/x.log",))
    assert "behind" in found
    assert "behind/x.log" not in found

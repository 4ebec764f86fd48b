"""What root does not work in, because others can change it."""

import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from dora_systemd.trust.tree import strange_part

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root has files of others")


@pytest.fixture
def project() -> Iterator[Path]:
    """A directory that only root can replace, with all of the way to it."""
    with TemporaryDirectory(dir="/var/tmp", prefix="dora-systemd-") as directory:
        place = Path(directory, "robot")
        (place / "models").mkdir(parents=True)
        (place / "a.py").write_text("")
        (place / "models" / "m.bin").write_text("")
        (place / "link").symlink_to("/etc/passwd")
        for one in (place, place / "models"):
            one.chmod(0o755)
        yield place


def test_all_of_it_is_roots(project: Path) -> None:
    assert strange_part(project) == ""
    assert strange_part(f"{project}/models/../") == ""


@pytest.mark.parametrize("name", ["", "a.py", "models", "models/m.bin", "link"])
def test_a_part_is_not_roots(project: Path, name: str) -> None:
    os.chown(project / name, 1234, 1234, follow_symlinks=False)
    assert strange_part(project) == f"{project / name} belongs to uid 1234"


@pytest.mark.parametrize("mode", [0o775, 0o757, 0o1777])
def test_others_can_write_into_a_directory(project: Path, mode: int) -> None:
    (project / "models").chmod(mode)
    assert strange_part(project) == f"{project}/models can be changed by others than root"


def test_a_link_to_a_directory_is_looked_through_once(project: Path) -> None:
    """The last part of the way may be root's link; what it leads to counts."""
    way = project.with_name("way")
    way.symlink_to(project)
    os.chown(project / "a.py", 1234, 1234)
    assert "a.py belongs to" in strange_part(way)


def test_the_way_to_it(tmp_path: Path) -> None:
    missing = Path("/usr/no-such-directory/below")
    assert strange_part(missing) == "", "root makes it"
    assert strange_part("/tmp/no-such-directory") == (
        "others than root can replace /tmp/no-such-directory"
    )
    home = tmp_path / "home"
    home.mkdir()
    os.chown(home, 1234, 1234)
    assert strange_part(home / "robot").startswith("others than root can replace /")

"""Unit files that survive a power cut."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.host.unit_files import write_link, write_unit_file
from dora_systemd.adapters.releases.store import make_directories
from dora_systemd.errors import DoraSystemdError


def test_a_unit_file_and_its_name_are_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def note(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))  # noqa: PTH115
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    path = tmp_path / "new/dora-robot.service.d/60.conf"
    write_unit_file(path, "[Service]\n")
    assert synced[0].startswith(f"{path.parent}/.60.conf."), "what is in it, before its name"
    assert set(synced[1:]) == {str(path.parent), str(tmp_path / "new"), str(tmp_path)}
    synced.clear()
    write_unit_file(path, "[Unit]\n")
    assert synced[1:] == [str(path.parent)]


def test_a_place_that_cannot_be_looked_at_is_an_error_that_names_it(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 256) / "dora-robot.service"
    with pytest.raises(DoraSystemdError, match=f"^cannot write {path}: File name too long$"):
        write_unit_file(path, "[Service]\n")


@pytest.mark.parametrize("umask", [0, 0o077])
def test_no_umask_lets_others_write_or_keeps_them_from_reading(tmp_path: Path, umask: int) -> None:
    modes: list[int] = []
    made = Path.mkdir

    def note(path: Path, mode: int = 0o777, **options: bool) -> None:
        made(path, mode, **options)
        modes.append(path.stat().st_mode & 0o777)

    before = os.umask(umask)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Path, "mkdir", note)
            write_unit_file(tmp_path / "a/b/dora-robot.service", "[Service]\n")
            make_directories(tmp_path / "c/d")
            write_link(tmp_path / "e/f.target.wants/dora.target", "../dora.target")
    finally:
        os.umask(before)
    assert modes == [0o755 & ~umask] * 6, "as they were made"
    for place in ("a", "a/b", "c", "c/d", "e", "e/f.target.wants"):
        assert (tmp_path / place).stat().st_mode & 0o777 == 0o755

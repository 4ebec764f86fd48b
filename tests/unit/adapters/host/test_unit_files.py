"""Unit files that survive a power cut."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.host.unit_files import write_unit_file
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

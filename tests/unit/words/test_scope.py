"""Machines that were not booted with systemd: what to do there."""

from pathlib import Path

import pytest

from dora_systemd.scope import without_systemd


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("proc/sys/kernel/osrelease", "6.6.87-microsoft-standard-WSL2\n", "/etc/wsl.conf"),
        (".dockerenv", "", "podman run --systemd=always"),
        ("run/.containerenv", "", "podman run --systemd=always"),
        ("proc/sys/kernel/osrelease", "6.12.1-arm64\n", "make it the init system"),
    ],
)
def test_machines_without_systemd(tmp_path: Path, file: str, text: str, expected: str) -> None:
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(text)
    assert expected in without_systemd(tmp_path)
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    assert without_systemd(tmp_path) == ""

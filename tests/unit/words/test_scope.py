"""Machines that were not booted with systemd, and files that cannot be written: what to do."""

import errno
import os
import pwd
from pathlib import Path

import pytest

from dora_systemd.scope import Scope, place_hint, without_systemd

USER = Scope(is_user=True, uid=1000)


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


@pytest.mark.parametrize(
    ("path", "number", "hint"),
    [
        ("/var/lib/dora-systemd/releases/x", errno.EACCES, "use sudo, or --user for a dataflow"),
        ("/home/joe/.local/state", errno.EACCES, "HOME is '/home/joe': use one in which you"),
        ("/proc/.local/state", errno.ENOENT, "HOME is '/home/joe': use one in which you"),
        ("/home/joe/.config/systemd/user", errno.EROFS, "the file system is mounted read-only"),
        ("/var/lib/dora-systemd/releases/x", errno.EROFS, "the file system is mounted read-only"),
        ("/home/joe/.local/state", errno.ENOSPC, "see df"),
    ],
)
def test_places_that_cannot_be_written(
    path: str, number: int, hint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/joe")
    assert place_hint(Path(path), OSError(number, "no")).startswith(hint)


def test_a_directory_of_another_user_in_the_own_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    path = tmp_path / ".local/a b"
    hint = place_hint(path, PermissionError(errno.EACCES, "no"))
    assert hint == f"a directory above it belongs to another user: namei -l '{path}'"


@pytest.mark.parametrize("given", ["relative", "", None])
def test_a_home_that_depends_on_the_directory_is_ignored(
    given: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/joe")
    assert USER.state_root == Path("/home/joe/.local/state")
    if given is None:
        monkeypatch.delenv("HOME")
    else:
        monkeypatch.setenv("HOME", given)
    own = pwd.getpwuid(os.getuid()).pw_dir
    assert USER.state_root == Path(own, ".local/state")


@pytest.mark.parametrize(
    ("is_user", "uid", "command"),
    [
        (False, 0, "doractl"),
        (True, 1000, "doractl"),
        (True, 0, "doractl --user"),
        (False, 1000, "sudo doractl"),
    ],
)
def test_a_recommended_command_works_for_the_user(is_user: bool, uid: int, command: str) -> None:
    assert Scope(is_user, uid).command == command

"""What a start finds on the machine."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.sight import Sight
from dora_systemd.verbs.start.where import find_uv, given_variables
from tests.unit.fakes.programs import make_program


@pytest.mark.parametrize(
    "present, expected",
    [
        ([], ""),
        (["second"], "second"),
        (["second", "first"], "first"),  # as a shell finds it
        (["home/.cargo/bin"], "home/.cargo/bin"),
        (["home/.cargo/bin", "home/.local/bin"], "home/.local/bin"),
        (["home/.local/bin", "second"], "second"),  # PATH has precedence over the home directory
        (["home"], ""),
    ],
)
def test_where_uv_is(tmp_path: Path, present: list[str], expected: str) -> None:
    for place in present:
        make_program(tmp_path / place / "uv", "exit 0")
    path = f"{tmp_path}/first::{tmp_path}/second"
    found = find_uv(path, Sight(), f"{tmp_path}/home")
    assert found == (f"{tmp_path}/{expected}/uv" if expected else "")


def test_without_a_home_directory_there_is_path_only(tmp_path: Path) -> None:
    make_program(tmp_path / ".local/bin/uv", "exit 0")
    assert find_uv("", Sight(), "") == ""
    assert find_uv("", Sight(), str(tmp_path)) == f"{tmp_path}/.local/bin/uv"


def test_a_uv_that_cannot_be_executed_is_none(tmp_path: Path) -> None:
    (tmp_path / "uv").write_text("#!/bin/sh\n")
    assert find_uv(str(tmp_path), Sight()) == ""


def test_a_relative_file_of_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "more.env").write_text("LIMIT=3\n")
    settings = resolve_settings({"env_file": ("more.env",)}, {}, [])
    assert given_variables(settings, Sight()) == {"LIMIT": "3"}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root reads what others may not")
def test_a_link_of_another_user_to_variables_of_root(tmp_path: Path) -> None:
    """Every user sees the variables of a unit."""
    secret, file = tmp_path / "secret", tmp_path / "home/own.env"
    secret.write_text("TOKEN=root\n")
    secret.chmod(0o600)
    file.parent.mkdir()
    os.chown(file.parent, 65534, 65534)
    settings = resolve_settings({"env_file": (str(file),)}, {}, [])
    file.write_text("TOKEN=own\n")
    os.chown(file, 65534, 65534)
    assert given_variables(settings, Sight()) == {"TOKEN": "own"}
    file.unlink()
    file.symlink_to(secret)
    with pytest.raises(DoraSystemdError, match="is a symbolic link that users other than root"):
        given_variables(settings, Sight())


class OthersSight(Sight):
    """The sight of an account that can read nothing."""

    def read(self, path: str) -> bytes:
        raise PermissionError(13, "Permission denied", path)


def test_who_must_be_able_to_read_an_environment_file() -> None:
    """The caller is root, who can; it is read as the user of the dataflow, for whom it is not."""
    settings = resolve_settings({"env_file": ("/srv/vars",)}, {}, ())
    lent = replace(settings, lent=frozenset({"/srv/vars"}))
    with pytest.raises(DoraSystemdError, match="/srv/vars: permission denied") as caught:
        given_variables(lent, OthersSight())
    assert caught.value.hint == "let the user that the dataflow runs as read it"

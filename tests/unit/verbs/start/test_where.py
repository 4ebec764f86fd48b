"""What a start finds on the machine."""

from pathlib import Path

import pytest

from dora_systemd.trust.sight import Sight
from dora_systemd.verbs.start.where import find_uv
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

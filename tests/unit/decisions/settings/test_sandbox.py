"""Credentials: names, files, what is refused, and that only paths get into the unit."""

import os
import socket
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import node_environment, parse_assignment
from dora_systemd.decisions.properties.assignments import parse_property
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.settings.sandbox import (
    CREDENTIALS,
    MOST_OF_CREDENTIALS,
    credential_properties,
)
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.startable import check_credentials, credential_files
from tests.unit.fakes.manager import options

USER = Scope(is_user=True, uid=os.getuid())


def test_flags_files_and_which_wins() -> None:
    beside = {"credentials": {"token": "token", "key": "/etc/key"}}
    machine = {"credentials": ["token=/etc/token", "ca=/etc/ca"]}
    files = [("/srv/robot.systemd.yml", beside), ("/etc/dora-systemd/config.yml", machine)]
    settings = resolve_settings({"credential": (), "credentials": ("key=/k=1",)}, {}, files)
    assert settings[CREDENTIALS] == {"token": "/srv/token", "ca": "/etc/ca", "key": "/k=1"}


@pytest.mark.parametrize(
    "text",
    [
        "token",
        "=x",
        "a/b=x",
        "a:b=x",
        "..=x",
        ".=x",
        "a b=x",
        "é=x",
        f"{'a' * 256}=x",
        "a=",
        "a=x\\",
    ],
)
def test_bad_flags(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot .*\(--credential\)$") as caught:
        resolve_settings({"credentials": (text,)}, {}, [])
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint


names = st.from_regex(r"[a-zA-Z0-9._%=$-]{3,40}", fullmatch=True).filter(
    lambda name: "=" not in name
)
paths = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1).map(lambda one: f"/{one}")


@given(st.dictionaries(names, paths, min_size=1))
def test_the_unit_says_the_same_as_a_property(files: dict[str, str]) -> None:
    files = {name: file.rstrip("\\") for name, file in files.items()}
    (one,) = credential_properties(files).values()
    values = [parse_property(f"LoadCredential={name}:{file}") for name, file in files.items()]
    assert [pair for each in values for pair in each["LoadCredential"].value] == list(one.value)
    assert {each["LoadCredential"].signature for each in values} == {one.signature}


def test_none_is_no_property() -> None:
    assert credential_properties({}) == {}


def test_relative_paths_are_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    settings = resolve_settings({"credentials": ("x=../t", "y=t")}, {}, [])
    assert credential_files(settings) == {"x": f"{tmp_path}/t", "y": f"{tmp_path}/a/t"}


def test_a_unit_has_the_path_and_not_the_secret(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("hunter2")
    settings = resolve_settings({"credentials": (f"token={tmp_path}/token",)}, {}, [])
    context = UnitContext("/usr/bin/python3", False, credentials=credential_files(settings))
    text = format_unit(unit_properties(options(), context, settings))
    assert f"LoadCredential=token:{tmp_path}/token\n" in text
    assert "hunter2" not in text


def test_files_that_are_refused(tmp_path: Path) -> None:
    good = tmp_path / "good"
    good.write_bytes(b"x" * MOST_OF_CREDENTIALS)
    check_credentials(USER, {"good": str(good)})
    os.mkfifo(tmp_path / "fifo")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(tmp_path / "socket"))
    (tmp_path / "more").write_text("x")
    for name, words in {
        ".": "it is a directory",
        "fifo": "it is not a regular file",
        "socket": "it is not a regular file",
        "none": "there is no such file",
        "good/x": "there is no such file",
        "more": "it is too large",
    }.items():
        with pytest.raises(DoraSystemdError, match=words) as caught:
            check_credentials(USER, {"good": str(good), "token": f"{tmp_path}/{name}"})
        assert caught.value.code is ExitCode.BAD_INPUT
        assert caught.value.message.startswith(f"cannot use {tmp_path}")


@pytest.mark.skipif(os.getuid() == 0, reason="root can read everything")
def test_unreadable(tmp_path: Path) -> None:
    (tmp_path / "closed").touch(mode=0)
    closed = {"token": str(tmp_path / "closed")}
    with pytest.raises(DoraSystemdError, match="permission denied"):
        check_credentials(USER, closed)
    # There it is root who reads.
    check_credentials(Scope(is_user=False, uid=os.getuid()), closed)


def test_nodes_keep_the_directory_and_nobody_else_names_it() -> None:
    directory = {"CREDENTIALS_DIRECTORY": "/run/credentials/x"}
    assert node_environment({**directory, "NOTIFY_SOCKET": "/x"}) == directory
    with pytest.raises(DoraSystemdError, match="CREDENTIALS_DIRECTORY"):
        parse_assignment("CREDENTIALS_DIRECTORY=/tmp")


@pytest.mark.skipif(os.getuid() != 0, reason="gives files away")
@pytest.mark.parametrize("what", ["file", "directory", "link"])
def test_a_file_that_others_can_replace_is_refused(tmp_path: Path, what: str) -> None:
    """PID 1 follows its path anew at each start, as root."""
    place = tmp_path / "place"
    place.mkdir()
    path = place / "token"
    path.write_text("secret")
    system = Scope(is_user=False, uid=0)
    check_credentials(system, {"token": str(path)})
    if what == "link":
        path = place / "link"
        path.symlink_to("token")
        os.chown(path, 4_000_001, 0, follow_symlinks=False)
    else:
        os.chown(path if what == "file" else place, 4_000_001, 0)
    with pytest.raises(DoraSystemdError) as caught:
        check_credentials(system, {"token": str(path)})
    words = (
        "a symbolic link that users" if what == "link" else "as credential token: users other than"
    )
    assert words in caught.value.message

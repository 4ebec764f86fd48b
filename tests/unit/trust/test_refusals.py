"""What is not read, not followed, not connected to and not run: in which words, and what to do."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.files import MAX_BYTES, append_lines, read_file, read_own_file
from dora_systemd.trust.locks import open_lock
from dora_systemd.trust.paths import list_directory, reached
from dora_systemd.trust.programs import check_program, own_account
from dora_systemd.trust.sight import Sight
from dora_systemd.trust.sockets import connect_unix

root_only = pytest.mark.skipif(os.geteuid() != 0, reason="has files of others")
NOBODY = 65534
Read = Callable[[Path], object]


def missing(path: Path) -> None:
    del path


def looping(path: Path) -> None:
    path.symlink_to(path.name)


def too_large(path: Path) -> None:
    path.write_bytes(bytes(MAX_BYTES + 1))


@pytest.mark.parametrize(
    ("make", "reason", "hint"),
    [
        (missing, "there is no such file", "correct the path"),
        (looping, "its symbolic links form a loop", "correct the path"),
        (Path.mkdir, "it is a directory", "give the file in it"),
        (os.mkfifo, "it is not a regular file", "give a file"),
        (too_large, "it is larger than 1024 KiB", "give a smaller file"),
    ],
)
def test_a_file_that_the_caller_has_named(
    tmp_path: Path, make: Callable[[Path], None], reason: str, hint: str
) -> None:
    path = tmp_path / "robot.yml"
    make(path)
    with pytest.raises(DoraSystemdError) as caught:
        read_own_file(path)
    assert caught.value.message == f"cannot read {path}: {reason}"
    assert (caught.value.hint, caught.value.code) == (hint, ExitCode.BAD_INPUT)


@pytest.mark.parametrize("read", [read_own_file, lambda path: read_file(path).data])
def test_the_largest_file_is_read_whole(tmp_path: Path, read: Read) -> None:
    path = tmp_path / "large"
    path.write_bytes(b"x" * MAX_BYTES)
    assert read(path) == b"x" * MAX_BYTES


@pytest.mark.parametrize("read", [read_own_file, read_file])
def test_a_name_that_is_none(read: Read) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        read(Path("/tmp/a\0b"))
    assert "embedded null" in caught.value.message
    assert caught.value.hint == ""


def test_a_file_of_others_that_is_too_large_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.yml"
    path.write_bytes(b"12345")
    with pytest.raises(DoraSystemdError) as caught:
        read_file(path, 4)
    assert caught.value.message == f"cannot read {path}: it is larger than 0 KiB"
    assert read_file(path, 5).data == b"12345"


def test_a_file_of_lines_that_others_can_change(tmp_path: Path) -> None:
    path = tmp_path / "history"
    path.touch()
    path.chmod(0o666)
    with pytest.raises(DoraSystemdError) as caught:
        append_lines(path, b"x\n")
    assert caught.value.message == f"cannot read {path}: another user can change it"
    assert (caught.value.hint, caught.value.code) == ("remove it", ExitCode.BAD_INPUT)


@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_whoever_can_write_can_change_it(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "history"
    path.touch()
    path.chmod(mode)
    with pytest.raises(DoraSystemdError, match="another user can change it"):
        append_lines(path, b"x\n")


def test_a_lock_is_opened_without_waiting(tmp_path: Path) -> None:
    (tmp_path / "inhibit.lock").touch()
    lock = open_lock(tmp_path)
    assert lock is not None
    flags = fcntl.fcntl(lock, fcntl.F_GETFL)
    wanted = os.O_RDWR | os.O_APPEND | os.O_NONBLOCK
    assert flags & wanted == wanted
    os.close(lock)


def test_only_so_many_names_are_listed(tmp_path: Path) -> None:
    for name in ("c", "a", "b"):
        (tmp_path / name).touch()
    assert list_directory(tmp_path, 9) == ["a", "b", "c"]
    assert len(list_directory(tmp_path, 2)) == 2
    assert list_directory(tmp_path, 0) == []


@root_only
def test_a_link_that_others_can_change(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    os.chown(tmp_path / "theirs", NOBODY, NOBODY)
    link = tmp_path / "theirs/link"
    link.symlink_to("/etc/passwd")
    with pytest.raises(DoraSystemdError) as caught, reached(link):
        pass
    reason = f"{link} is a symbolic link that users other than root can change"
    assert caught.value.message == f"cannot read {link}: {reason}"
    assert caught.value.hint == "give the path that it leads to"
    assert caught.value.code is ExitCode.BAD_INPUT


def test_a_loop_of_links_ends(tmp_path: Path) -> None:
    path = tmp_path / "robot"
    looping(path)
    with pytest.raises(OSError, match="Too many levels"), reached(path):
        pass


def test_what_is_no_socket(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    path.touch()
    with pytest.raises(DoraSystemdError) as caught:
        connect_unix(path, 5.0)
    assert caught.value.message == f"cannot connect to {path}: it is not a socket"
    assert caught.value.hint == "restart that dataflow"
    assert caught.value.code is ExitCode.NO_PERMISSION


@root_only
def test_a_socket_in_a_directory_below_that_of_another_user(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    (theirs / "robot").mkdir(parents=True)
    os.chown(theirs, NOBODY, NOBODY)
    path = theirs / "robot/runner.sock"
    with pytest.raises(DoraSystemdError) as caught:
        connect_unix(path, 5.0)
    reason = "nobody owns a directory above it"
    assert caught.value.message == f"cannot connect to {path}: {reason}"


def program(path: Path, first: str, mode: int = 0o755) -> str:
    path.write_text(f"{first}\nexit 1\n")
    path.chmod(mode)
    return str(path)


@root_only
def test_a_program_that_others_can_change(place: Path) -> None:
    theirs = program(place / "theirs", "#!/bin/sh", 0o757)
    with pytest.raises(DoraSystemdError) as caught:
        check_program(theirs)
    assert caught.value.message == f"cannot run {theirs} as root: others can change it"
    assert caught.value.hint == "run it as its owner, or have it installed by root"
    assert caught.value.code is ExitCode.NO_PERMISSION


@root_only
@pytest.mark.parametrize("words", ["env theirs", "env -S theirs -x", "env -i theirs"])
def test_what_env_would_run(place: Path, monkeypatch: pytest.MonkeyPatch, words: str) -> None:
    program(place / "theirs", "#!/bin/sh", 0o757)
    monkeypatch.setenv("PATH", f"{place}:{os.environ['PATH']}")
    script = program(place / "script", f"#!/usr/bin/{words}")
    with pytest.raises(DoraSystemdError, match="theirs as root: others can change it"):
        check_program(script)


@root_only
def test_a_script_of_a_script_of_a_script(place: Path) -> None:
    name = program(place / "0", "#!/bin/sh")
    for number in range(1, 4):
        name = program(place / str(number), f"#!{name}")
    with pytest.raises(DoraSystemdError) as caught:
        check_program(name)
    reason = "its interpreter is a script of a script"
    assert caught.value.message == f"cannot run {name} as root: {reason}"
    check_program(str(place / "1"))


def test_the_account_of_this_process_has_a_name() -> None:
    account = own_account()
    assert (account.uid, account.gid) == (os.geteuid(), os.getegid())
    assert account.name
    assert account.groups == tuple(os.getgroups())


def test_what_the_caller_sees(tmp_path: Path) -> None:
    sight, path = Sight(), tmp_path / "file"
    path.write_text("x")
    path.chmod(0o644)
    assert [sight.exists(str(path)), sight.is_writable(str(path))] == [True, True]
    assert [sight.is_directory(str(path)), sight.is_program(str(path))] == [False, False]
    assert [sight.is_directory(str(tmp_path)), sight.is_program(str(tmp_path))] == [True, False]
    path.chmod(0o755)
    assert sight.is_program(str(path))
    assert sight.read(str(path)) == b"x"
    assert sight.modified_ns(str(path)) == path.stat().st_mtime_ns
    gone = str(tmp_path / "gone")
    assert not (sight.exists(gone) or sight.is_writable(gone))
    assert sight.modified_ns(gone) == 0
    (tmp_path / "link").symlink_to("file")
    assert sight.real(str(tmp_path / "link")) == str(path.resolve())
    assert sight.real("/tmp/a\0b") == "/tmp/a\0b"
    with pytest.raises(OSError, match="Invalid argument"):
        sight.read("/tmp/a\0b")

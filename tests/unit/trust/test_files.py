"""Files that nodes can replace, and files of lines, which are appended whole and repaired."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import TABLE, CellPaths
from dora_systemd.trust.files import MAX_TABLE, append_lines, read_lines, read_table, read_times

STATUS = CellStatus(uuid="u", nodes={"a": NodeStatus("running", 7)})
MOST = 1000


def test_what_the_runner_has_written(tmp_path: Path) -> None:
    (tmp_path / TABLE).write_text(STATUS.to_json())
    assert read_table(tmp_path) == STATUS
    CellPaths(tmp_path).times.write_bytes(b"12345678")
    assert read_times(tmp_path, 8) == b"12345678"


def test_nothing_is_there(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for directory in (tmp_path, tmp_path / "missing", tmp_path / "file"):
        assert read_table(directory) is None
        assert read_times(directory, 8) == b""


def test_more_than_a_runner_writes(tmp_path: Path) -> None:
    (tmp_path / TABLE).write_text(STATUS.to_json().ljust(MAX_TABLE + 1))
    with pytest.raises(DoraSystemdError):
        read_table(tmp_path)
    (tmp_path / TABLE).write_text(STATUS.to_json().ljust(MAX_TABLE))
    assert read_table(tmp_path) == STATUS
    CellPaths(tmp_path).times.write_bytes(b"123456789")
    assert read_times(tmp_path, 8) == b""


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
def test_what_is_no_file(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / TABLE)
    make(CellPaths(tmp_path).times)
    with pytest.raises(DoraSystemdError):
        read_table(tmp_path)
    assert read_times(tmp_path, 8) == b""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_table_that_another_user_has_put_there(tmp_path: Path) -> None:
    os.chown(tmp_path, 1000, -1)
    (tmp_path / TABLE).write_text(STATUS.to_json())
    os.chown(tmp_path / TABLE, 1001, -1)
    with pytest.raises(DoraSystemdError) as caught:
        read_table(tmp_path)
    assert "it is not of the user whose dataflow it is: " in caught.value.message
    assert caught.value.hint == "another user put it there"
    assert caught.value.code is ExitCode.BAD_INPUT


def test_append_and_read(tmp_path: Path) -> None:
    path = tmp_path / "history"
    assert read_lines(path, MOST) == b""
    assert read_lines(path / "x", MOST) == b""
    append_lines(path, b"one\n")
    append_lines(path, b"two\nthree\n")
    assert read_lines(path, MOST) == b"one\ntwo\nthree\n"
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(DoraSystemdError, match="larger"):
        read_lines(path, 3)


@pytest.mark.parametrize("unfinished", [b"hal", b"{" * 5000])
def test_an_unfinished_line_goes(tmp_path: Path, unfinished: bytes) -> None:
    path = tmp_path / "history"
    for before in (b"", b"one\n"):
        path.write_bytes(before + unfinished)
        path.chmod(0o600)
        append_lines(path, b"two\n")
        assert path.read_bytes() == before + b"two\n"


def test_what_others_can_change_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_bytes(b"secret\n")
    target.chmod(0o600)
    link, hard, fifo = (tmp_path / name for name in ("link", "hard", "fifo"))
    link.symlink_to(target)
    hard.hardlink_to(target)
    os.mkfifo(fifo)
    (tmp_path / "open").write_bytes(b"")
    (tmp_path / "open").chmod(0o666)
    for path in (link, hard, fifo, tmp_path / "open", tmp_path):
        with pytest.raises(DoraSystemdError):
            append_lines(path, b"x\n")
    assert target.read_bytes() == b"secret\n"

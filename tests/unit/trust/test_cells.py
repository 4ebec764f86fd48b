"""What is read of the files in a RuntimeDirectory, which the nodes' user can replace."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import TABLE, CellPaths
from dora_systemd.trust.cells import MAX_TABLE, read_table, read_times

STATUS = CellStatus(uuid="u", nodes={"a": NodeStatus("running", 7)})


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

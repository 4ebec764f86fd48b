"""A file of lines: appended whole, repaired after a power cut, refused if others can change it."""

import os
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.lines import append_lines, read_lines

MOST = 1000


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

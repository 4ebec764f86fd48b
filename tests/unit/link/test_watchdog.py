"""A link tells systemd that it is alive."""

import socket
from pathlib import Path

import pytest

from dora_systemd.link.__main__ import Watchdog
from dora_systemd.link.talk import Program, Talk


def test_each_turn_feeds_it_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    runner, ours = socket.socketpair()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, runner, ours:
        systemd.bind(path)
        systemd.setblocking(False)
        with Program("sh", ["-c", "echo mark; seq 1 5000"]) as ssh:
            Talk(ours, ssh, "mark", b"", Watchdog().feed).carry()
        assert systemd.recv(100) == b"WATCHDOG=1"
        with pytest.raises(BlockingIOError):
            systemd.recv(100)


def test_without_systemd_it_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    made: list[object] = []
    monkeypatch.setattr(socket, "socket", made.append)
    Watchdog().feed()
    assert not made

"""The file descriptor store, with a socket of our own as systemd."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.adapters.host import fd_store


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(tmp_path / "notify"))
        server.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield server


def test_store(manager: socket.socket) -> None:
    reader, writer = os.pipe()
    fd_store.store(reader, "m1.camera")
    os.close(reader)
    os.write(writer, b"kept")
    text, (fd,), _, _ = socket.recv_fds(manager, 100, 1)
    assert text.decode().splitlines() == ["FDSTORE=1", "FDNAME=dora-log-m1.camera", "FDPOLL=0"]
    assert os.read(fd, 10) == b"kept"
    os.close(fd)
    os.close(writer)
    fd_store.forget("m1.camera")
    assert manager.recv(100) == b"FDSTOREREMOVE=1\nFDNAME=dora-log-m1.camera"


def test_all_is_forgotten(manager: socket.socket) -> None:
    fd_store.forget_all(["camera"])
    names = [manager.recv(100).decode().partition("FDNAME=")[2] for _ in range(4)]
    assert names == ["dora-log-camera", "dora-log-", "dora-life", "dora-ring"]


def test_without_systemd(manager: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("LISTEN_PID", "LISTEN_FDNAMES", "LISTEN_FDS"):
        monkeypatch.delenv(key, raising=False)
    for where in ("", "/nonexistent"):
        monkeypatch.setenv("NOTIFY_SOCKET", where)
        fd_store.store(0, "a")
        fd_store.forget_inherited()
    os.fstat(0)  # what was to be stored is still open
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        manager.recv(100)


def test_the_first_life(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("FDSTORE", "LISTEN_FDNAMES"):
        monkeypatch.delenv(key, raising=False)
    assert not fd_store.is_first_life()  # systemd 252 does not tell that it has a store
    monkeypatch.setenv("FDSTORE", "4096")
    assert fd_store.is_first_life()
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-log-camera:dora-log-camera")
    assert not fd_store.is_first_life()


def test_lives_that_are_forgotten_leave_a_trace(manager: socket.socket) -> None:
    """First the trace: between two messages the process can be killed."""
    fd_store.forget_lives()
    text, fds, _, _ = socket.recv_fds(manager, 100, 1)
    assert text.decode().splitlines() == ["FDSTORE=1", "FDNAME=dora-log-", "FDPOLL=0"]
    assert manager.recv(100) == b"FDSTOREREMOVE=1\nFDNAME=dora-life"
    os.close(*fds)
    manager.close()


CHILD = """
import os
from dora_systemd.adapters.host import fd_store
os.environ["LISTEN_PID"] = str(os.getpid())
fd_store.forget_inherited()
for fd in (3, 4, 5):
    try:
        os.fstat(fd)
        print(fd, "open")
    except OSError:
        print(fd, "closed")
print([key for key in os.environ if key.startswith("LISTEN_")])
"""


def test_forget_inherited(manager: socket.socket) -> None:
    script = f'exec 3</dev/null 4</dev/null 5</dev/null; exec "{sys.executable}" -c "$0"'
    environment = {**os.environ, "LISTEN_FDS": "3", "LISTEN_FDNAMES": "dora-log-a:other:dora-log-a"}
    done = subprocess.run(
        ["sh", "-c", script, CHILD], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["3 closed", "4 open", "5 closed", "[]"]
    assert manager.recv(100) == b"FDSTOREREMOVE=1\nFDNAME=dora-log-a"
    manager.close()

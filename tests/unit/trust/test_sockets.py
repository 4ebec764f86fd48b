"""Sockets that others own: nothing is sent before it is known whose they are."""

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.socket_table import loopback_listeners
from dora_systemd.trust.sockets import connect_unix, peer_of, require_listener

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="gives files away")
STRANGER = 4_000_001


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "robot").mkdir()
    return tmp_path / "robot/runner.sock"


@pytest.fixture
def listener(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))
        one.listen()
        yield one


def test_connects_to_the_owner_of_the_directory(path: Path, listener: socket.socket) -> None:
    with connect_unix(path, 5.0) as stream:
        assert peer_of(stream) == os.getuid()
        served, _ = listener.accept()
        with served:
            stream.sendall(b"x")
            assert served.recv(1) == b"x"


@as_root
@pytest.mark.usefixtures("listener")
@pytest.mark.parametrize("what", ["directory", "socket"])
def test_a_socket_of_somebody_else(path: Path, what: str) -> None:
    os.chown(path if what == "socket" else path.parent, STRANGER, STRANGER)
    with pytest.raises(DoraSystemdError, match=f"uid {STRANGER}") as caught:
        connect_unix(path, 5.0)
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_a_listener_that_is_somebody_else(path: Path, listener: socket.socket) -> None:
    """A socket that its owner has bound may be listened to by whoever was given it."""
    with pytest.raises(DoraSystemdError, match=r"runner\.sock: it is "):
        connect_unix(path, 5.0, lambda _: os.getuid() + 1)
    served, _ = listener.accept()
    with served:
        assert served.recv(1) == b"", "nothing was sent"


@as_root
def test_who_listens_counts_and_not_who_has_the_file(path: Path) -> None:
    """The whole of it with this kernel: mallory's process behind a socket of root's."""
    one = socket.socket(socket.AF_UNIX)
    one.bind(str(path))

    def listen() -> None:
        libc_setresuid(STRANGER)
        one.listen()

    thread = threading.Thread(target=listen)
    thread.start()
    thread.join()
    with one, pytest.raises(DoraSystemdError, match=f"it is uid {STRANGER}"):
        connect_unix(path, 5.0)


def libc_setresuid(uid: int) -> None:
    """Of the calling thread alone, which is what the system call does."""
    import ctypes
    import platform

    number = {"x86_64": 117, "aarch64": 147}.get(platform.machine())
    if number is None:
        pytest.skip("no number of setresuid here")
    ctypes.CDLL(None).syscall(number, uid, uid, uid)


@pytest.mark.parametrize("kind", ["file", "link", "directory", "fifo"])
def test_what_is_no_socket(path: Path, kind: str) -> None:
    if kind == "file":
        path.touch()
    elif kind == "link":
        path.symlink_to("/run/systemd/notify")
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(DoraSystemdError, match="it is not a socket"):
        connect_unix(path, 5.0)


def test_nobody_there(path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        connect_unix(path, 5.0)
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))
    with pytest.raises(ConnectionRefusedError):
        connect_unix(path, 5.0)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "::", "::1", "127.0.0.2"])
def test_who_gets_what_is_sent_to_a_port(host: str, tcp_listener: socket.socket) -> None:
    """A listener on another address is none of ours, and cannot shut us out either."""
    port = tcp_listener.getsockname()[1]
    expected = frozenset() if host in ("::1", "127.0.0.2") else {os.getuid()}
    assert loopback_listeners(port) == expected


def test_a_port_must_be_the_units() -> None:
    with socket.create_server(("127.0.0.1", 0)) as one:
        port = one.getsockname()[1]
        require_listener(port, os.getuid())
        with pytest.raises(DoraSystemdError, match="listens there, not uid") as caught:
            require_listener(port, STRANGER)
        assert caught.value.code is ExitCode.NO_PERMISSION
    with pytest.raises(DoraSystemdError, match="nothing listens there") as caught:
        require_listener(port, os.getuid())
    assert caught.value.code is ExitCode.NOT_RUNNING
    with pytest.raises(DoraSystemdError, match=f"uid {STRANGER} listens"):
        require_listener(1, 8, lambda _: frozenset({STRANGER, 8}))

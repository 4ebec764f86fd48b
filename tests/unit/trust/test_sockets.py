"""Sockets that others own: nothing is sent before it is known whose they are."""

import os
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.sockets import (
    Address,
    Lookup,
    Owner,
    connect_unix,
    find_owner,
    is_open_beyond,
    listener_uids,
    loopback_listeners,
    peer_of,
    peer_uid,
    read_owner,
    require_listener,
)

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


HEAD = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout"
PEER, OWN = ("127.0.0.1", 40000), ("127.0.0.1", 53290)
LINE = (
    "  1: {peer} {own} {state} 00000000:00000000 00:00000000 00000000 {uid:5} 0 {inode} 1 0 20 4\n"
)


def table(path: Path, *lines: str) -> Lookup:
    path.write_text(HEAD + "\n" + "".join(lines))
    return lambda peer, own: read_owner(peer, own, (path,))


def line(uid: int, inode: int, peer: str = "0100007F:9C40", own: str = "0100007F:D02A") -> str:
    return LINE.format(peer=peer, own=own, state="01", uid=uid, inode=inode)


def test_found_by_both_ends(tmp_path: Path) -> None:
    others = line(7, 1, own="0100007F:D02B"), line(8, 2, peer="0100007F:9C41")
    look = table(tmp_path / "tcp", *others, line(1001, 3))
    assert peer_uid(PEER, OWN, look) == 1001
    assert peer_uid(OWN, PEER, look) is None


def test_a_closed_socket_is_nobodys(tmp_path: Path) -> None:
    """The kernel calls the owner of a socket that was closed root."""
    assert peer_uid(PEER, OWN, table(tmp_path / "tcp", line(0, 0))) is None


def test_a_socket_that_is_closed_meanwhile_is_nobodys() -> None:
    answers = iter([Owner(0, 5), *[Owner(0, 0)] * 10])
    assert peer_uid(PEER, OWN, lambda _peer, _own: next(answers)) is None


def test_one_answer_that_fails_is_made_up_for() -> None:
    answers = iter([Owner(7, 5), None, Owner(7, 5), Owner(7, 5)])
    assert peer_uid(PEER, OWN, lambda _peer, _own: next(answers)) == 7


def test_without_a_table(tmp_path: Path) -> None:
    def look(peer: Address, own: Address) -> Owner | None:
        return read_owner(peer, own, (tmp_path / "none",))

    assert peer_uid(PEER, OWN, look) is None
    assert peer_uid(("nonsense", 1), OWN, look) is None
    assert peer_uid(("nonsense", 1), OWN) is None


@pytest.mark.parametrize("look", [find_owner, read_owner])
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_with_this_kernel(host: str, look: Lookup, tcp_listener: socket.socket) -> None:
    del host
    with socket.create_connection(tcp_listener.getsockname()[:2]) as one:
        peer, own = ends(one)
        assert peer_uid(peer, own, look) == os.getuid()
        assert look(peer, own) == read_owner(peer, own)
        assert os.getuid() in listener_uids(own[1])
        other, _ = tcp_listener.accept()
    # Closed by its process, but not by the other side: the kernel still has it.
    assert peer_uid(peer, own, look) is None
    other.close()


def ends(connection: socket.socket) -> tuple[Address, Address]:
    peer, own = connection.getsockname(), connection.getpeername()
    return (peer[0], peer[1]), (own[0], own[1])


def test_a_socket_that_has_gone_costs_no_table() -> None:
    """Who connects and vanishes again and again would keep the gateway reading."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as client:
            peer, own = client.getsockname(), client.getpeername()
            if find_owner(peer, own) is None:
                pytest.skip("the kernel does not tell of single sockets")
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert find_owner(peer, own, read=lambda *_: pytest.fail("it reads")) is None


def test_a_kernel_that_knows_of_no_socket_is_not_believed() -> None:
    def ignorant(*_ends: object) -> Owner:
        raise FileNotFoundError

    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
    ):
        found = find_owner(client.getsockname(), client.getpeername(), ignorant)
        assert found is not None
        assert found.uid == os.getuid()


@pytest.mark.parametrize(("address", "is_open"), [("127.0.0.1", False), ("127.0.0.2", True)])
def test_a_port_that_is_open_beyond_the_loopback_address(address: str, is_open: bool) -> None:
    with socket.create_server((address, 0)) as one:
        port = one.getsockname()[1]
        assert is_open_beyond(port) is is_open
    assert not is_open_beyond(port)

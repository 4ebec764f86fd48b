"""Whose the other end of a connection is."""

import os
import socket
import struct
from pathlib import Path

import pytest

from dora_systemd.trust.socket_table import (
    Address,
    Lookup,
    Owner,
    find_owner,
    is_open_beyond,
    listener_uids,
    peer_uid,
    read_owner,
)

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

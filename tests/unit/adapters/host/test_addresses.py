"""The addresses of this machine. Those of 127.0.0.0/8 are always there."""

import errno
import socket

from dora_systemd.adapters.host.addresses import is_own, listen_error, source_address

NOBODYS = "192.0.2.1"
"""Of a network for documentation, see RFC 5737."""


def test_the_way_to_an_address_begins_at_one_of_this_machine() -> None:
    assert source_address("127.0.0.5") == "127.0.0.1"
    assert source_address("127.0.0.5", "127.0.0.3") == "127.0.0.3"
    assert source_address("127.0.0.5", NOBODYS) == ""
    assert source_address("::1", "127.0.0.1") == ""
    assert source_address("not an address") == ""


def test_what_a_machine_has() -> None:
    assert is_own("127.0.0.3")
    assert not is_own(NOBODYS)


def test_a_port_that_is_taken() -> None:
    with socket.create_server(("127.0.0.3", 0)) as one:
        port = one.getsockname()[1]
        assert listen_error("127.0.0.3", port) == errno.EADDRINUSE
        assert listen_error("127.0.0.4", port) == 0

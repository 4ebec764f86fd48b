"""Where the daemons of several machines listen."""

import socket
from pathlib import Path

import pytest

from dora_systemd.decisions.machines.wire import Forwards
from dora_systemd.paths import CellPaths
from dora_systemd.runner.machines import ports
from dora_systemd.runner.machines.engine import SharedEngine
from dora_systemd.runner.machines.zenoh import head_arguments

PORTS = Forwards(61000, {"head": 61001, "gpu": 61002})


@pytest.mark.parametrize(("addresses", "timeout"), [((), "0"), (("10.99.0.1", "10.99.0.2"), None)])
def test_nodes_dial_each_other_only_without_ssh(
    addresses: tuple[str, ...], timeout: str | None, tmp_path: Path
) -> None:
    engine = SharedEngine("/bin/dora", CellPaths(tmp_path), {}, addresses)
    found = engine._environment.get("DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS")
    assert found == timeout
    (_, listen, *_) = head_arguments(PORTS, {}, addresses)
    assert listen == f"{addresses[0] if addresses else '127.0.0.1'}:61001"


def test_the_arguments_of_a_daemon() -> None:
    words = head_arguments(PORTS, {}, ["fd00::1"])
    assert words[:3] == ("--zenoh-listen", "[fd00::1]:61001", "--zenoh-config-overlay")
    assert head_arguments(PORTS, {"ZENOH_CONFIG": "/x"}, ()) == (
        "--zenoh-listen",
        "127.0.0.1:61001",
    )


def test_a_port_has_to_be_free_on_the_own_address_too() -> None:
    with socket.create_server(("127.0.0.3", 0)) as one:
        taken = one.getsockname()[1]
        some = range(taken, taken + 40)
        found = ports.choose_ports(("gpu",), ("127.0.0.3", "127.0.0.4"), some)
        assert taken not in {found.coordinator, *found.zenoh.values()}

"""Where the daemons of several machines listen."""

import socket
from pathlib import Path

import pytest

from dora_systemd.paths import CellPaths
from dora_systemd.runner.machines import ports
from dora_systemd.runner.machines.engine import SharedEngine, zenoh_arguments


@pytest.mark.parametrize(("addresses", "timeout"), [((), "0"), (("10.99.0.1", "10.99.0.2"), None)])
def test_nodes_dial_each_other_only_without_ssh(
    addresses: tuple[str, ...], timeout: str | None, tmp_path: Path
) -> None:
    engine = SharedEngine("/bin/dora", CellPaths(tmp_path), {}, addresses)
    found = engine._environment.get("DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS")
    assert found == timeout
    assert engine._address == (addresses[0] if addresses else "127.0.0.1")


def test_the_arguments_of_a_daemon() -> None:
    words = zenoh_arguments(61000, {}, "fd00::1")
    assert words[:3] == ("--zenoh-listen", "[fd00::1]:61000", "--zenoh-config-overlay")
    assert zenoh_arguments(61000, {"ZENOH_CONFIG": "/x"}, "127.0.0.1") == (
        "--zenoh-listen",
        "127.0.0.1:61000",
    )


def test_a_port_has_to_be_free_on_the_own_address_too(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.3", 0)) as one:
        taken = one.getsockname()[1]
        monkeypatch.setattr(ports, "PORT_RANGE", range(taken, taken + 40))
        found = ports.choose_ports(("gpu",), ("127.0.0.3", "127.0.0.4"))
        assert taken not in {found.coordinator, *found.zenoh.values()}

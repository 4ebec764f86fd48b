"""The port of `doractl up`."""

from collections.abc import Mapping

import pytest

from dora_systemd.decisions.gateway.place import port_drop_in, port_of, wanted_port
from dora_systemd.errors import DoraSystemdError, ExitCode


@pytest.mark.parametrize(
    ("option", "environ", "port"),
    [
        (None, {}, None),
        (None, {"DORA_DAEMON_PORT": "", "DORA_COORDINATOR_ADDR": ""}, None),
        (53291, {"DORA_DAEMON_PORT": "53292"}, 53291),
        (None, {"DORA_DAEMON_PORT": "53292", "DORA_COORDINATOR_ADDR": "localhost:1"}, 53292),
        (None, {"DORA_COORDINATOR_ADDR": "localhost:53293"}, 53293),
        (None, {"DORA_COORDINATOR_ADDR": "127.0.0.1"}, None),
    ],
)
def test_precedence(option: int | None, environ: Mapping[str, str], port: int | None) -> None:
    assert wanted_port(option, environ) == port


@pytest.mark.parametrize(
    "environ",
    [
        {"DORA_DAEMON_PORT": "0"},
        {"DORA_DAEMON_PORT": "65536"},
        {"DORA_DAEMON_PORT": "٣"},
        {"DORA_DAEMON_PORT": "9" * 5000},
        {"DORA_DAEMON_PORT": "0650001"},
        {"DORA_DAEMON_PORT": "x"},
        {"DORA_COORDINATOR_ADDR": "0.0.0.0"},
        {"DORA_COORDINATOR_ADDR": "192.168.1.5:53290"},
        {"DORA_COORDINATOR_ADDR": "robot.example"},
        {"DORA_COORDINATOR_ADDR": "::1"},
        {"DORA_COORDINATOR_ADDR": "localhost:x"},
        {"DORA_COORDINATOR_ADDR": ":53290"},
    ],
)
def test_refusals(environ: Mapping[str, str]) -> None:
    with pytest.raises(DoraSystemdError, match="cannot ") as caught:
        wanted_port(None, environ)
    assert caught.value.code is ExitCode.USAGE
    assert next(iter(environ)) in caught.value.message
    assert caught.value.hint


def test_listen_property() -> None:
    assert port_of([["Stream", "127.0.0.1:53290"]]) == 53290
    assert port_of([["Stream", "/run/x.sock"], ["Stream", "[::1]:1"]]) == 1
    assert port_of([]) is None
    assert port_of("") is None


def test_drop_in_replaces_the_address() -> None:
    lines = port_drop_in(53291).splitlines()
    assert lines[1:] == ["[Socket]", "ListenStream=", "ListenStream=127.0.0.1:53291"]

"""What head and member do before they import the rest of the runner, and where daemons listen."""

import json
import os
import socket
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.runner_socket.door import Door
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.wire import Beat, Forwards, Part, format_message
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.machines.boot import (
    GREETED,
    choose_ports,
    greeting,
    head_arguments,
    received,
    shared_environment,
)
from tests.unit.fakes.boots import QuietBoot, standard_input
from tests.unit.fakes.manager import UUID

PORTS = Forwards(61000, {"head": 61001, "gpu": 61002})
OPTIONS = RunnerOptions(
    *("robot", UUID, "/srv/flow.yml", "/srv", "/bin/dora"),
    placed=(Placed("mid", "gpu"),),
    machine="gpu",
)
PART = Part("robot", UUID, "gpu", "s3cret", 61001, 61003, "0" * 64, 5, "0.1.0", "1.1.0")


def ask(path: Path, line: bytes) -> socket.socket:
    link = socket.socket(socket.AF_UNIX)
    link.settimeout(30)
    link.connect(str(path))
    link.sendall(line)
    return link


def test_a_link_gets_its_ports_before_anything_else_is_there(tmp_path: Path) -> None:
    path = tmp_path / "runner.sock"
    door = Door(path, lambda line: greeting(line, ("gpu",), PORTS))
    wish = {"verb": "link", "machine": "gpu"}
    with (
        ask(path, json.dumps(wish).encode() + b"\nmore") as link,
        ask(path, b'{"verb": "coordinator"}\n') as other,
    ):
        assert link.recv(1000) == format_message(PORTS)
        wait_met(door, 2)
        listener, kept = door.hand_over()
        said = sorted(one.said for one in kept)
        assert said[0] == b'{"verb": "coordinator"}\n'
        line, _, rest = said[1].partition(b"\n")
        assert (json.loads(line), rest) == ({**wish, GREETED: True}, b"more")
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.recv(1)
        for one in (listener, *(one.connection for one in kept)):
            one.close()
    assert path.stat().st_mode & 0o777 == 0o600


def wait_met(door: Door, count: int) -> None:
    while len(door._kept) < count:
        threading.Event().wait(0.01)


@pytest.mark.parametrize(
    "line", [b"", b"[]", b"{", b'{"verb": "link"}', b'{"verb": "link", "machine": "arm"}', b"\xff"]
)
def test_nobody_else_gets_ports(line: bytes) -> None:
    assert greeting(line, ("gpu",), PORTS) == (b"", line)


def test_a_member_is_told_by_its_standard_input(tmp_path: Path) -> None:
    with standard_input(format_message(PART), format_message(Beat())):
        boot = QuietBoot(OPTIONS, CellPaths(tmp_path), tmp_path, {})
        assert str(Path("/proc/self/fd/0").readlink()) == os.devnull
    assert boot.part == PART
    assert boot.rest == format_message(Beat())
    assert boot.daemon() is None
    assert boot.started["port"] == PART.coordinator
    assert "s3cret" not in str(boot.started)
    assert not boot.connection.get_inheritable()
    boot.connection.close()


@pytest.mark.parametrize("said", [b"", b"hello\n", format_message(replace(PART, machine="arm"))])
def test_a_member_that_is_told_something_else(tmp_path: Path, said: bytes) -> None:
    with standard_input(said, b"\n"), pytest.raises(DoraSystemdError):
        QuietBoot(OPTIONS, CellPaths(tmp_path), tmp_path, {})


def test_a_member_that_nobody_has_started() -> None:
    with standard_input(is_given=False), pytest.raises(OSError, match="temporarily unavailable"):
        received()
    with Path(os.devnull).open() as nothing:
        old = os.dup(0)
        os.dup2(nothing.fileno(), 0)
        try:
            with pytest.raises(OSError, match="socket"):
                received()
        finally:
            os.dup2(old, 0)
            os.close(old)


@pytest.mark.parametrize(("addresses", "timeout"), [((), "0"), (("10.99.0.1", "10.99.0.2"), None)])
def test_nodes_dial_each_other_only_without_ssh(
    addresses: tuple[str, ...], timeout: str | None
) -> None:
    found = shared_environment({}, addresses).get("DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS")
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
        found = choose_ports(("gpu",), ("127.0.0.3", "127.0.0.4"), some)
        assert taken not in {found.coordinator, *found.zenoh.values()}

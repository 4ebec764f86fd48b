"""doractl up."""

import errno
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.place import SERVICE_UNIT, SOCKET_UNIT
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.gateway import read_gateway
from dora_systemd.verbs.up import (
    PORT_FILE,
    open_port,
    refuse_problems,
    start_boot_target,
)
from tests.unit.fakes.manager import FakeManager, ScopeIn, options


class Systemd(FakeManager):
    """Reads the socket's port from the files, as systemd does when it is told to."""

    def __init__(self, runtime: Path) -> None:
        super().__init__()
        self.etc = runtime.parent.parent.parent / "etc"
        self.runtime = runtime

    def reset_failed(self, unit: str) -> None:
        self.calls.append(("reset", unit))

    def reload(self) -> None:
        super().reload()
        path = self.runtime / SOCKET_UNIT
        if path.exists():
            drop_in = self.runtime / PORT_FILE
            text = (drop_in if drop_in.exists() else path).read_text()
            address = text.rpartition("ListenStream=")[2].split()[0]
            self.add_socket(str(path), address)

    def add_socket(self, path: str, address: str, active: str = "inactive") -> None:
        self.units[SOCKET_UNIT] = {
            "LoadState": "loaded",
            "FragmentPath": path,
            "ActiveState": active,
            "Listen": [["Stream", address]],
        }
        self.after_job[SOCKET_UNIT] = {"ActiveState": "active"}


@pytest.fixture
def systemd(scope: ScopeIn) -> Systemd:
    return Systemd(scope.root / "systemd/system")


@pytest.fixture
def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


@pytest.fixture
def used_port() -> Iterator[int]:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        yield one.getsockname()[1]


def test_units_are_written_where_there_are_none(
    systemd: Systemd, scope: ScopeIn, free_port: int
) -> None:
    assert open_port(systemd, scope, free_port) == free_port
    written = {str(p.relative_to(systemd.runtime)) for p in systemd.runtime.rglob("*.*")}
    assert written >= {SOCKET_UNIT, SERVICE_UNIT, PORT_FILE}
    assert f"{SERVICE_UNIT}.d/10-sandbox.conf" in written
    assert read_gateway(systemd).is_up
    # Again elsewhere: it moves.
    systemd.calls.clear()
    systemd.units[SOCKET_UNIT]["ActiveState"] = "active"
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        other = one.getsockname()[1]
    assert open_port(systemd, scope, other) == other
    assert systemd.calls[0] == ("StopUnit", SOCKET_UNIT)


def test_a_users_gateway_has_no_sandbox_file(tmp_path: Path, free_port: int) -> None:
    scope = ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")
    systemd = Systemd(scope.root / "systemd/user")
    open_port(systemd, scope, free_port)
    names = {path.name for path in systemd.runtime.rglob("*.*")}
    assert names == {SOCKET_UNIT, SERVICE_UNIT, "50-port.conf", f"{SOCKET_UNIT}.d"}


def test_packaged_units_stay(systemd: Systemd, scope: ScopeIn, free_port: int) -> None:
    systemd.add_socket(f"/usr/lib/systemd/system/{SOCKET_UNIT}", f"127.0.0.1:{free_port}")
    assert open_port(systemd, scope, None) == free_port
    assert not list(systemd.runtime.rglob("*"))
    assert ("reload",) not in systemd.calls


def test_a_port_in_use(systemd: Systemd, scope: ScopeIn, used_port: int) -> None:
    with pytest.raises(DoraSystemdError, match="it is in use by process ") as caught:
        open_port(systemd, scope, used_port)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert f"doractl up --port {used_port + 1}" in caught.value.hint
    assert "doractl start" in caught.value.hint
    assert systemd.calls == []
    assert not list(scope.root.rglob("*"))


def test_a_port_without_a_listener(systemd: Systemd, scope: ScopeIn) -> None:
    """As of a client of anything, or of a process that does not listen yet."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        with pytest.raises(DoraSystemdError, match="in use, and nothing listens on it") as caught:
            open_port(systemd, scope, one.getsockname()[1])
    assert caught.value.hint.startswith("a connection may have had it in the last minute")


def test_a_port_that_is_not_for_everyone(
    systemd: Systemd, scope: ScopeIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    with pytest.raises(DoraSystemdError, match="cannot open port 80") as caught:
        open_port(systemd, scope, 80)
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_problems_of_the_machine() -> None:
    found = [Finding("linger", State.WARNING, "x"), Finding("dora", State.OK, "y")]
    refuse_problems(found)
    found.append(Finding("systemd", State.PROBLEM, "version 1 is too old", "upgrade"))
    with pytest.raises(DoraSystemdError, match="cannot run dataflows here: systemd: version 1"):
        refuse_problems(found)


@pytest.mark.parametrize(("active", "started"), [("inactive", ["robot"]), ("active", [])])
def test_what_a_boot_starts(
    active: str, started: list[str], systemd: Systemd, scope: ScopeIn
) -> None:
    assert start_boot_target(systemd, scope) == []
    systemd.units[BOOT_TARGET] = {"LoadState": "loaded", "ActiveState": active}
    systemd.enable_unit_files(["dora-robot.service", "dora-runs.service"])
    systemd.add(options("runs"))
    # Enabled before the target was set up: the target does not start it.
    before = systemd.etc / "systemd" / scope.word / "multi-user.target.wants"
    before.mkdir()
    (before / "dora-before.service").symlink_to("/dev/null")
    assert start_boot_target(systemd, scope) == started

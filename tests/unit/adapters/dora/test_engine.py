"""What coordinator and daemon are started with."""

import asyncio
import os
import signal
import socket
import time
from pathlib import Path

import pytest

from dora_systemd.adapters.dora import engine
from dora_systemd.decisions.cell.environment import node_environment
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import LIBEXEC, daemon_variables
from dora_systemd.runner.cell.engine import Engine
from tests.unit.fakes.manager import UUID


def test_what_is_systemds_stays_with_the_runner() -> None:
    given = {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1", "PATH": "/bin", "MODEL": "yolo"}
    assert node_environment(given) == {"PATH": "/bin", "MODEL": "yolo"}


def test_everything_listens_on_loopback_and_with_a_token() -> None:
    coordinator = engine.coordinator_command("/dora")
    assert coordinator[coordinator.index("--interface") + 1] == "127.0.0.1"
    assert "--auth" in coordinator
    daemon = engine.daemon_command("/dora", 1, 2)
    assert "--zenoh-no-multicast" in daemon
    assert daemon[daemon.index("--coordinator-addr") + 1] == "127.0.0.1"


def test_the_users_own_token_is_not_overwritten() -> None:
    made = engine.coordinator_environment({"HOME": "/h", "XDG_CONFIG_HOME": "/h/c"}, Path("/run/c"))
    assert made["XDG_CONFIG_HOME"] == made["TMPDIR"] == "/run/c"


def test_what_the_daemon_is_told_beside_the_variables_of_the_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUST_BACKTRACE", "1")
    options = RunnerOptions("robot", UUID, "/p/d.yml", "/p", "/dora", venv="/p/.venv")
    unit = Path("/sys/fs/cgroup/unit")
    given = daemon_variables(options, CellPaths(tmp_path), unit, {"PATH": "/bin"})
    assert given["PATH"] == f"{LIBEXEC}:/bin"
    assert (LIBEXEC / "python").is_file()
    assert given["DORA_SYSTEMD_PYTHON"] == "/p/.venv/bin/python"
    assert given["DORA_SYSTEMD_DIRECTORY"] == "/p"
    assert given["DORA_SYSTEMD_GROUP"] == str(unit)
    assert "RUST_BACKTRACE" not in given
    assert given["DORA_SYSTEMD_UNSET"].split() == ["DORA_QUIET", "DORA_QUIET", "PERL_BADLANG"]


def test_children_and_their_ends(tmp_path: Path) -> None:
    child = engine.spawn("x", ["/bin/sh", "-c", "echo out; echo err >&2; exit 3"], {}, tmp_path)
    with os.fdopen(child.output) as output:
        assert output.read() == "out\nerr\n"
    assert child.popen.wait() == 3


def test_a_child_that_exits(tmp_path: Path) -> None:
    child = engine.spawn("a) b", ["/bin/sleep", "1000"], {}, tmp_path)
    os.close(child.output)
    assert not child.is_exiting()
    child.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, child.popen.pid, os.WEXITED | os.WNOWAIT)
    assert child.is_exiting(), "nobody has waited for it"
    child.popen.wait()
    assert child.is_exiting(), "somebody has"


def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    try:
        engine.spawn("x", ["/nonexistent"], {}, tmp_path)
    except OSError as error:
        assert error.errno == 2
    else:
        raise AssertionError


def test_a_reserved_port_is_for_a_daemon_only() -> None:
    with engine.reserved_port() as held, socket.socket() as other, socket.socket() as daemon:
        with pytest.raises(OSError, match="already in use"):
            other.bind(held.getsockname())
        daemon.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        daemon.bind(held.getsockname())
        daemon.listen()
        socket.create_connection(held.getsockname()).close()


PORT = "echo first; printf 'Listening on port 47'; echo 11; echo more; exec sleep 1000"


@pytest.mark.parametrize(
    ("script", "port"),
    [(PORT, 4711), ("echo no", 0), ("exec sleep 1000", 0), ("echo is not Listening on port 1", 0)],
)
def test_the_port_of_a_coordinator_is_read_as_soon_as_it_is_printed(
    tmp_path: Path, script: str, port: int
) -> None:
    child = engine.spawn("coordinator", ["/bin/sh", "-c", script], {}, tmp_path)
    assert engine.read_port(child, 0.1 if "sleep" in script and not port else 20) == port
    if port:
        assert child.said.startswith(b"first\nListening on port 4711\n")
    child.popen.kill()
    child.popen.wait()
    os.close(child.output)
    os.close(child.pidfd)


def open_files() -> set[str]:
    return {name for name in map(str, range(256)) if Path(f"/proc/self/fd/{name}").is_symlink()}


def test_a_run_leaves_no_descriptor_behind(tmp_path: Path) -> None:
    async def one_run() -> None:
        dora = Engine("/bin/true", CellPaths(tmp_path), {})
        child = dora.start_coordinator()
        engine.watch(asyncio.get_running_loop(), child, lambda *_: None)
        dora.kill()
        os.close(child.output)

    async def runs() -> None:
        await one_run()
        before = open_files()
        await one_run()
        assert open_files() == before

    asyncio.run(runs())


def test_a_child_that_does_not_die_does_not_hold_the_end(tmp_path: Path) -> None:
    async def work() -> None:
        child = engine.spawn("x", ["/bin/sleep", "1000"], {}, tmp_path)
        began = time.monotonic()
        child.close(asyncio.get_running_loop(), 0.05)
        assert time.monotonic() - began < 5
        child.popen.kill()
        child.popen.wait()
        os.close(child.output)

    asyncio.run(work())

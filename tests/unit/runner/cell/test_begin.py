"""What a cell begins with: its lock, and what its coordinator and daemon are told."""

import os
import sys
from pathlib import Path

import pytest

from dora_systemd.adapters.dora.engine import Child
from dora_systemd.decisions.cell.needs import NodeNeed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import (
    LIBEXEC,
    OPENSSL,
    daemon_variables,
    leave_out_openssl,
    let_openssl_in,
    make_lock,
    read_token,
    start_coordinator,
    start_daemon,
)
from tests.unit.fakes.manager import options
from tests.unit.fakes.programs import make_program

OWN = ("DORA_QUIET", "RUST_BACKTRACE", "PERL_BADLANG")
SAYS = '{ pwd; echo "$@"; env; } >"$0.$1"'


def test_openssl_is_left_out_and_let_in(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in OPENSSL:
        monkeypatch.setitem(sys.modules, name, sys.modules.get(name, os))
    leave_out_openssl()
    with pytest.raises(ImportError):
        import ssl  # noqa: F401
    let_openssl_in()
    assert not any(name in sys.modules for name in OPENSSL)
    monkeypatch.setitem(sys.modules, "ssl", os)
    let_openssl_in()
    assert sys.modules["ssl"] is os, "one that is loaded stays"


def test_a_lock_file_is_a_new_one(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    make_lock(path)
    with path.open() as held:
        make_lock(path)
        assert os.fstat(held.fileno()).st_nlink == 0
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.fixture
def paths(tmp_path: Path) -> CellPaths:
    paths = CellPaths(tmp_path / "cell")
    paths.root.mkdir()
    return paths


def variables(paths: CellPaths, given: dict[str, str], runner: RunnerOptions) -> dict[str, str]:
    return daemon_variables(runner, paths, Path("/sys/fs/cgroup/unit"), given)


def test_what_the_daemon_and_the_launcher_are_told(
    paths: CellPaths, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in OWN:
        monkeypatch.delenv(name, raising=False)
    python = make_program(tmp_path / "venv/bin/python")
    runner = options(venv=str(tmp_path / "venv"), working_directory="/srv/robot")
    found = variables(paths, {"PATH": "/opt/bin"}, runner)
    assert found == {
        **{"DORA_QUIET": "1", "RUST_BACKTRACE": "0", "PERL_BADLANG": "0"},
        "DORA_SYSTEMD_UNSET": "DORA_QUIET DORA_QUIET RUST_BACKTRACE PERL_BADLANG",
        "DORA_SYSTEMD_CELL": str(paths.root),
        "DORA_SYSTEMD_GROUP": "/sys/fs/cgroup/unit",
        "DORA_SYSTEMD_LIBEXEC": str(LIBEXEC),
        "DORA_SYSTEMD_DIRECTORY": "/srv/robot",
        "DORA_SYSTEMD_PYTHON": python,
        "PATH": f"{LIBEXEC}:/opt/bin",
    }
    assert variables(paths, {}, runner)["PATH"] == f"{LIBEXEC}:{os.defpath}"
    monkeypatch.setenv("RUST_BACKTRACE", "full")
    found = variables(paths, {}, runner)
    assert "RUST_BACKTRACE" not in found, "who sets it in the unit wants to see it"
    assert found["DORA_SYSTEMD_UNSET"] == "DORA_QUIET DORA_QUIET PERL_BADLANG"


def test_rights_of_nodes_are_told_if_there_are_any(paths: CellPaths) -> None:
    runner = options(needs=(NodeNeed("a", "/dev/x"),))
    assert "DORA_SYSTEMD_RIGHTS" not in variables(paths, {}, runner)


def end(child: Child) -> None:
    """Wait for a child that ends by itself."""
    child.popen.wait()
    os.close(child.pidfd)
    os.close(child.output)


def test_a_coordinator_and_a_daemon(paths: CellPaths, tmp_path: Path) -> None:
    dora = make_program(tmp_path / "dora", SAYS)
    given = {"PATH": os.environ["PATH"], "MINE": "yes"}
    end(start_coordinator(dora, paths, given, 5555))
    first = Path(f"{dora}.coordinator").read_text()
    assert first.startswith(f"{paths.coordinator}\n")
    assert "--port 5555" in first
    assert "MINE=yes" in first
    assert paths.coordinator.stat().st_mode & 0o777 == 0o700
    (paths.coordinator / ".dora-token").write_text(" secret\n")
    assert read_token(paths) == "secret"
    for token, wanted in (("", "secret"), ("theirs", "theirs")):
        started = start_daemon(dora, paths, 6666, given, token, ["--more"])
        end(started.child)
        second = Path(f"{dora}.daemon").read_text()
        command = second.split("\n")[1]
        assert command.endswith(" --more")
        assert "6666" in command
        assert str(started.listen) in command
        assert f"DORA_AUTH_TOKEN={wanted}\n" in second
        assert "MINE=yes" in second
    assert paths.daemon.stat().st_mode & 0o777 == 0o700


def test_what_is_no_dora(paths: CellPaths, tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        start_coordinator(str(tmp_path / "missing"), paths, {})
    assert caught.value.code is ExitCode.NO_DORA

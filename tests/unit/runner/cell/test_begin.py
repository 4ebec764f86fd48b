"""What a cell begins with: its lock, and what its coordinator and daemon are told."""

import os
import pwd
import subprocess
import sys
from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup.groups import SUPERVISOR, group_of
from dora_systemd.adapters.dora.engine import Child
from dora_systemd.decisions.cell.core_dumps import CORE_PATTERN
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import (
    LIBEXEC,
    OPENSSL,
    SIGACTION,
    daemon_variables,
    enter_supervisor,
    leave_out_openssl,
    let_openssl_in,
    make_lock,
    nodes_environment,
    read_token,
    start_coordinator,
    start_daemon,
)
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import options, with_limits, with_texts
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
        **SIGACTION,
    }
    assert variables(paths, {}, runner)["PATH"] == f"{LIBEXEC}:{os.defpath}"
    monkeypatch.setenv("RUST_BACKTRACE", "full")
    found = variables(paths, {}, runner)
    assert "RUST_BACKTRACE" not in found, "who sets it in the unit wants to see it"
    assert found["DORA_SYSTEMD_UNSET"] == "DORA_QUIET DORA_QUIET PERL_BADLANG"


def test_rights_of_nodes_are_told_if_there_are_any(paths: CellPaths) -> None:
    runner = with_texts(options(), "a:needs=/dev/x")
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
        started.held.close()
        assert f"DORA_AUTH_TOKEN={wanted}\n" in second
        assert "MINE=yes" in second
    assert paths.daemon.stat().st_mode & 0o777 == 0o700


def test_what_is_no_dora(paths: CellPaths, tmp_path: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        start_coordinator(str(tmp_path / "missing"), paths, {})
    assert caught.value.code is ExitCode.NO_DORA


def test_the_runner_moves_into_a_group_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As DelegateSubgroup= has it from systemd 254 on."""
    mount = fake_cgroups(monkeypatch, tmp_path)
    own = mount / group_of().lstrip("/")
    own.mkdir(parents=True, exist_ok=True)
    (own / SUPERVISOR).mkdir()
    (own / SUPERVISOR / "cgroup.procs").touch()
    if own.name == SUPERVISOR:
        assert enter_supervisor() == own.parent
    else:
        assert enter_supervisor() == own
        assert (own / SUPERVISOR / "cgroup.procs").read_text().strip() == "0"


@pytest.mark.parametrize("home", [None, "/srv/home"])
def test_nodes_have_what_a_prompt_has(monkeypatch: pytest.MonkeyPatch, home: str | None) -> None:
    for name in ("PWD", "HOME", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MINE", "yes")
    if home:
        monkeypatch.setenv("HOME", home)
    found = nodes_environment("/srv/robot")
    assert found["PWD"] == "/srv/robot"
    assert found["MINE"] == "yes"
    assert found["HOME"] == (home or pwd.getpwuid(os.getuid()).pw_dir)


def test_cpus_of_a_node_are_told_where_no_cgroup_binds_it(paths: CellPaths, tmp_path: Path) -> None:
    bound = with_limits(options(), limits_from("a:cpus=0"))
    told = daemon_variables(bound, paths, tmp_path, {})["DORA_SYSTEMD_RIGHTS"]
    assert told == "a /usr/bin/taskset -c 0\n* \n"
    limited = with_limits(options(), limits_from("a:memory_limit=1G"))
    assert "DORA_SYSTEMD_RIGHTS" not in daemon_variables(limited, paths, tmp_path, {})


def test_a_coordinator_takes_any_port(paths: CellPaths, tmp_path: Path) -> None:
    dora = make_program(tmp_path / "dora", SAYS)
    for _ in range(2):
        end(start_coordinator(dora, paths, {"PATH": os.environ["PATH"]}))
        assert "--port 0" in Path(f"{dora}.coordinator").read_text()


PIPED = "|/usr/lib/systemd/systemd-coredump %P %u %g %s %t %c %h %d %F\n"


@pytest.mark.parametrize(
    ("pattern", "limits", "soft"),
    [
        (PIPED, (0, 4096), 4096),
        (PIPED, (0, 0), 0),
        (PIPED, (1024, 4096), 1024),
        ("core\n", (0, 4096), 0),
    ],
)
def test_core_dumps_are_for_systemd_only(
    pattern: str, limits: tuple[int, int], soft: int, tmp_path: Path
) -> None:
    (tmp_path / CORE_PATTERN).parent.mkdir(parents=True)
    (tmp_path / CORE_PATTERN).write_text(pattern)
    script = (
        "import pathlib, resource, sys\n"
        "from dora_systemd.runner.cell.begin import allow_core_dumps\n"
        f"resource.setrlimit(resource.RLIMIT_CORE, {limits})\n"
        "allow_core_dumps(pathlib.Path(sys.argv[1]))\n"
        "print(*resource.getrlimit(resource.RLIMIT_CORE))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [str(soft), str(limits[1])]

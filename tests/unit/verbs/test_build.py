"""A build of a project where it is: by whom, with which commands, and how it ends."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.build import Project, _run_unit, _Runner, build, find_project
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.manager import FakeManager, PrintingManager
from tests.unit.fakes.programs import make_program

USER = Scope(is_user=True, uid=1000)
FLOW = "nodes: [{id: a, path: a.py, build: make}]\n"
SAYS = 'echo "${0##*/} $*"'


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a dora and a uv, and a caller who is not root."""
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    root = tmp_path / "project"
    (root / "flows").mkdir(parents=True)
    (root / "dataflow.yml").write_text(FLOW)
    (root / "flows/dataflow.yml").write_text(FLOW)
    make_program(tmp_path / "bin/dora", SAYS)
    make_program(tmp_path / ".local/bin/uv", SAYS)
    return root


def request(root: Path, file: str = "dataflow.yml", **flags: Any) -> StartRequest:
    environment = {"PATH": f"{root.parent}/bin:/usr/bin:/bin"}
    return StartRequest(str(root / file), None, flags, environment)


def found(root: Path, file: str = "dataflow.yml", **flags: Any) -> Project:
    return find_project(USER, request(root, file, **flags))


def built(root: Path, show: Callable[[str], None], **flags: Any) -> Project:
    return build(FakeManager, USER, request(root, **flags), show)


def test_the_commands_are_those_of_dora(root: Path) -> None:
    dora, flow = f"{root.parent}/bin/dora", f"{root}/dataflow.yml"
    assert found(root).commands == ((dora, "build", "--local", flow),)
    assert found(root, uv=True).commands == ((dora, "build", "--local", "--uv", flow),)


def test_a_lock_is_for_uv(root: Path) -> None:
    """uv is found where it installs itself, which is not on the PATH of ssh and sudo."""
    (root / "uv.lock").write_text("")
    project = found(root)
    sync = (f"{root.parent}/.local/bin/uv", "sync", "--directory", str(root))
    assert project.commands[0] == sync
    assert project.environment["UV_PROJECT_ENVIRONMENT"] == f"{root}/.venv"
    path = project.environment["PATH"].split(":")
    assert path[0] == f"{root}/.venv/bin"
    assert path[-1] == f"{root.parent}/.local/bin"  # for `dora build --uv`
    assert "UV_NO_CACHE" not in project.environment


@pytest.mark.parametrize("uv", [False, True])
def test_a_lock_above_the_dataflow(root: Path, uv: bool) -> None:
    """The virtual environment is where `start` looks; with --uv it is that of the project."""
    (root / "uv.lock").write_text("")
    (root / "pyproject.toml").write_text("")
    project = found(root, "flows/dataflow.yml", uv=uv, working_directory=str(root))
    assert project.lock == str(root)
    place = root if uv else root / "flows"
    assert project.environment["VIRTUAL_ENV"] == f"{place}/.venv"


def test_a_virtual_environment_that_is_given(root: Path) -> None:
    (root / "uv.lock").write_text("")
    for place in (root / "venv", root.parent / "venv"):
        make_program(place / "bin/python")
    assert found(root, venv=str(root.parent / "venv")).lock == ""
    own = found(root, venv=str(root / "venv"))
    assert (own.lock, own.environment["UV_PROJECT_ENVIRONMENT"]) == (str(root), f"{root}/venv")


def test_uv_may_bring_dora(root: Path) -> None:
    (root.parent / "bin/dora").unlink()
    with pytest.raises(DoraSystemdError, match="cannot find the dora command") as caught:
        found(root)
    assert caught.value.code is ExitCode.NO_DORA
    (root / "uv.lock").write_text("")
    assert found(root).commands[1][0] == "dora"  # the first one on PATH, when it comes to that


def test_a_lock_without_uv(root: Path) -> None:
    (root / "uv.lock").write_text("")
    (root.parent / ".local/bin/uv").unlink()
    with pytest.raises(DoraSystemdError, match=r"uv\.lock needs uv, which is not in PATH$"):
        found(root)


def test_output_streams(root: Path) -> None:
    (root / "uv.lock").write_text("")
    shown: list[str] = []
    project = built(root, shown.append)
    assert project.user == ""
    lines = [f"uv sync --directory {root}", f"dora build --local {root}/dataflow.yml"]
    assert "".join(shown).splitlines() == lines
    assert built(root, shown.append) == project  # twice


def test_a_build_that_fails(root: Path) -> None:
    make_program(root.parent / "bin/dora", "echo 'a: stdout   lost'; exit 3")
    with pytest.raises(DoraSystemdError) as caught:
        built(root, lambda _: None)
    assert caught.value.message.startswith(f"cannot build {root}/dataflow.yml: ")
    assert caught.value.message.endswith("; its last line: a: lost")


@pytest.mark.parametrize("error", [KeyboardInterrupt, BrokenPipeError])
def test_an_interrupted_build_leaves_nothing(root: Path, error: type[BaseException]) -> None:
    make_program(root.parent / "bin/dora", f"echo $$ >{root}/pid; echo x; exec sleep 1000")

    def stop(_text: str) -> None:
        raise error

    with pytest.raises(error):
        built(root, stop)
    stat = Path("/proc", (root / "pid").read_text().strip(), "stat")
    assert not stat.exists() or ") Z" in stat.read_text()


def test_who_may_not_build(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DoraSystemdError, match=r"nope\.yml: there is no such file"):
        found(root, "nope.yml")
    monkeypatch.setattr("os.access", lambda _path, mode: mode != os.W_OK)
    with pytest.raises(DoraSystemdError, match=f"you cannot write in {root}$") as caught:
        found(root)
    assert caught.value.code is ExitCode.NO_PERMISSION


def test_never_as_root(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    with pytest.raises(DoraSystemdError, match=r"^cannot build as root$"):
        found(root)
    with pytest.raises(DoraSystemdError, match=r"it would run as root$"):
        find_project(Scope(is_user=False, uid=0), request(root, user="root"))


def test_no_home_directory(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """uv can have neither a cache nor Pythons of its own."""
    monkeypatch.setenv("HOME", "/")
    assert found(root).environment["UV_NO_CACHE"] == "1"


PROJECT = Project("/srv/x.yml", "alice", "", (("/bin/dora", "build"),), {"A": "b"})


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_the_unit_of_a_build() -> None:
    manager = PrintingManager(b"one\n", refusal=b"failed: x")
    shown: list[str] = []
    before = open_files()
    run = _Runner(shown.append)
    assert _run_unit(manager, PROJECT, ["/bin/python"], run) == 0
    assert (shown, run.refusal) == (["one\n"], "failed: x")
    given = manager.given
    assert (given["User"], given["Environment"]) == ("alice", ("A=b",))
    assert given["NoNewPrivileges"]
    assert given["KillMode"] == "control-group"
    assert open_files() == before


def test_a_unit_that_cannot_start() -> None:
    with pytest.raises(DoraSystemdError, match=r"cannot build /srv/x\.yml: .*217"):
        manager = PrintingManager(status=217)
        _run_unit(manager, PROJECT, ["/bin/python"], _Runner(lambda _: None))


def test_an_interrupted_unit_is_stopped() -> None:
    def stop(_text: str) -> None:
        raise KeyboardInterrupt

    manager = PrintingManager(b"one\n")
    with pytest.raises(KeyboardInterrupt):
        _run_unit(manager, PROJECT, ["/bin/python"], _Runner(stop))
    assert manager.calls[-1][0] == "StopUnit"

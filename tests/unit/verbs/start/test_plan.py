"""From a request to a checked plan, with a dora of three lines."""

import os
import pwd
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.dora.check import check_access
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.table import ENV_FILE, SETTINGS, UV
from dora_systemd.decisions.settings.table import USER as USER_SETTING
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import Place, reached
from dora_systemd.trust.sight import LentSight, Sight, sight_of
from dora_systemd.verbs.releases.source import find_source
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.read import (
    SYSTEM_FILE,
    SettingsFile,
    config_files,
    named_places,
    read_files,
    read_settings_file,
)
from dora_systemd.verbs.start.request import StartRequest, current_directory, request_name
from dora_systemd.verbs.start.restart_ended import Asked, means_name
from dora_systemd.verbs.start.settings import check_config, require_modest, settings_of
from dora_systemd.verbs.start.where import account_of, choose_user
from tests.unit.fakes.programs import make_dora, make_program
from tests.unit.verbs.start.test_programs import install

USER = Scope(is_user=True, uid=os.getuid())
SYSTEM = Scope(is_user=False, uid=os.getuid())
FLOW = "nodes: [{id: a, path: a.py, inputs: {t: dora/timer/millis/100}}]\n"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "robot.yml").write_text(FLOW)
    (tmp_path / "a.py").write_text("")
    make_dora(tmp_path / "bin" / "dora", "1.1.0")
    return tmp_path


def plan_of(project: Path, environment: dict[str, str] | None = None, **flags: Any) -> Plan:
    variables = {"PATH": f"{project}/bin:/usr/bin:/bin", **(environment or {})}
    return make_plan(USER, StartRequest(str(project / "robot.yml"), None, flags, variables))


def test_a_plain_plan(project: Path) -> None:
    plan = plan_of(project)
    options = plan.options
    assert (plan.unit, options.name) == ("dora-robot.service", "robot")
    assert options.dataflow == str(project / "robot.yml")
    assert options.working_directory == str(project)
    assert options.dora == str(project / "bin" / "dora")
    assert options.venv is None
    assert plan.user is None
    assert plan.environment["PATH"].startswith(f"{project}/bin:")


def test_no_dataflow_here(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project)
    path = f"{project}/dataflow.yml"
    for request, hint in (
        (StartRequest("dataflow.yml"), "go to the directory of a dataflow, or name its file"),
        (StartRequest("./dataflow.yml"), "correct the path"),
        (StartRequest(path), "correct the path"),
        (StartRequest(path, "robot", uuid="u"), "put the file back, or start another one"),
    ):
        with pytest.raises(DoraSystemdError, match=f"{path}: there is no") as caught:
            make_plan(USER, request)
        assert caught.value.hint == hint
    with pytest.raises(DoraSystemdError, match="there is no such file") as caught:
        make_plan(USER, StartRequest("robt.yml"))
    assert caught.value.hint == "correct the path"


def test_no_directory_here(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = project / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(DoraSystemdError, match="the current directory was removed") as one:
        make_plan(USER, StartRequest("dataflow.yml"))
    assert one.value.code is ExitCode.BAD_INPUT
    assert plan_of(project).options.name == "robot"
    assert current_directory() == Path("/")
    assert means_name("robot")


def test_every_plan_has_a_uuid_of_its_own(project: Path) -> None:
    assert plan_of(project).options.uuid != plan_of(project).options.uuid


def test_a_flag_without_effect(project: Path) -> None:
    """A recorded start may have it: that of another version has accepted it."""
    watching = {"watch": ("*.py",)}
    with pytest.raises(DoraSystemdError, match="cannot use --watch without --hot-reload"):
        plan_of(project, watch=("*.py",))
    asked = Asked("robot", "u", str(project / "robot.yml"), watching)
    wanted = StartRequest("robot", environment={"PATH": f"{project}/bin"})
    assert make_plan(USER, asked.request(wanted)).options.name == "robot"
    with pytest.raises(DoraSystemdError, match="cannot use --watch without --hot-reload"):
        make_plan(USER, asked._replace(flags={}).request(wanted._replace(flags=watching)))
    again = asked._replace(flags={"hot_reload": True}).request(wanted._replace(flags=watching))
    assert make_plan(USER, again).options.of_dataflow("watch") == ("*.py",)


def test_interpreter(project: Path) -> None:
    """--venv, else VIRTUAL_ENV, else .venv beside the dataflow."""
    places = [project / name for name in ("flag", "variable", ".venv")]
    for place in places:
        make_program(place / "bin" / "python")
    flag, variable, beside = map(str, places)
    assert plan_of(project).options.venv == beside
    plan = plan_of(project, {"VIRTUAL_ENV": variable})
    assert plan.options.venv == variable
    assert plan.environment["VIRTUAL_ENV"] == variable
    assert plan.environment["PATH"].startswith(f"{variable}/bin:")
    assert plan_of(project, {"VIRTUAL_ENV": variable}, venv=flag).options.venv == flag
    assert plan.notes == ()
    lost = plan_of(project, {"VIRTUAL_ENV": "/nowhere"})
    assert lost.options.venv == beside
    assert lost.notes == ("VIRTUAL_ENV=/nowhere is not used: you find no Python there",)
    assert plan_of(project, {"VIRTUAL_ENV": "/nowhere"}, venv=flag).notes == ()


def test_environment(project: Path) -> None:
    (project / "one").write_text("A=1\nB=1\nC=1\n")
    (project / "two").write_text("B=2\nC=2\n")
    files = (str(project / "one"), str(project / "two"))
    plan = plan_of(project, env_file=files, env=("C=3",))
    assert plan.options.env_keys == ("A", "B", "C")
    assert {key: plan.environment[key] for key in "ABC"} == {"A": "1", "B": "2", "C": "3"}


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        ({"venv": "/nowhere"}, ExitCode.BAD_INPUT, "no bin/python"),
        ({"working_directory": "/nowhere"}, ExitCode.BAD_INPUT, "not a directory"),
        ({"dora": "/nowhere"}, ExitCode.NO_DORA, "/nowhere"),
        ({"user": "root"}, ExitCode.USAGE, "--user"),
        ({"env": ("X",)}, ExitCode.USAGE, "'X'"),
        ({"env_file": ("/nowhere",)}, ExitCode.BAD_INPUT, "/nowhere"),
    ],
)
def test_what_is_refused(project: Path, flags: dict[str, Any], code: ExitCode, words: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        plan_of(project, **flags)
    assert caught.value.code is code
    assert words in caught.value.message
    assert caught.value.hint


def test_what_dora_refuses(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not while the plan is made, which runs no dora: that is for the cell, or a dry run."""
    (project / "robot.yml").write_text("# refused\n" + FLOW)
    plan = plan_of(project)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)  # root would ask in a unit
    monkeypatch.setattr("dora_systemd.verbs.start.check.own_account", lambda: None)
    with pytest.raises(DoraSystemdError, match="it is refused") as caught:
        check_plan(no_manager, plan)
    assert caught.value.code is ExitCode.BAD_INPUT


def test_a_program_that_is_not_there(project: Path) -> None:
    (project / "robot.yml").write_text(FLOW.replace("a.py", "b.py"))
    with pytest.raises(DoraSystemdError, match=r"b\.py") as caught:
        plan_of(project)
    assert caught.value.code is ExitCode.BAD_INPUT


def no_manager() -> Any:
    raise AssertionError


def test_no_dora_runs_while_a_plan_is_made(project: Path) -> None:
    make_program(project / "bin" / "dora", f"touch {project}/proof")
    (project / "mod.yml").write_text("module: {name: m}\n" + FLOW)
    (project / "robot.yml").write_text("nodes: [{id: m, module: mod.yml}]\n")
    plan_of(project)
    assert not (project / "proof").exists()


def test_an_empty_path_is_not_the_working_directory() -> None:
    """In a script, a variable is not set."""
    request = StartRequest("")
    for use in (request_name, partial(make_plan, USER), partial(find_source, USER)):
        with pytest.raises(DoraSystemdError, match="cannot read '': no path"):
            use(request)


def test_names() -> None:
    assert request_name(StartRequest("/x/my flow.yml")) == "my-flow"
    assert request_name(StartRequest("/x/y.yml", "robot")) == "robot"
    with pytest.raises(DoraSystemdError):
        request_name(StartRequest("/x/y.yml", "../robot"))


def settings(scope: Scope, flow: Path, flags: dict[str, object] | None = None) -> Settings:
    request = StartRequest(str(flow), None, flags or {})
    return settings_of(scope, read_files(request), request)


def test_settings_files() -> None:
    home = {"HOME": "/home/alice"}
    user, system = config_files(home)
    assert user == Path("/home/alice/.config/dora-systemd/config.yml")
    assert system == Path("/etc/dora-systemd/config.yml")
    config = config_files({**home, "XDG_CONFIG_HOME": "/c"})[0]
    assert config == Path("/c/dora-systemd/config.yml")
    assert config_files({}) == [system]
    # A relative path in the variable is not valid.
    assert config_files({**home, "XDG_CONFIG_HOME": "c"})[0] == user


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("uv: true\nmemory_limi: 1\n", "unknown key 'memory_limi' at line 2"),
        ("nodes:\n  plot: {}\n  camera:\n    cpuu: 1\n", "of node 'camera' at line 4"),
        ("\nnodes: {camera: {cpuu: 1}}\n", "unknown key 'cpuu' of node 'camera' at line 2"),
        ("uv: [1]\n", "the value of uv is of another type at line 1"),
        ("env:\n  A: 1\n  B:\n", "the value of env.B is of another type at line 3"),
        ("uv: no\nmemory_limit: lots\n", "robot.systemd.yml at line 2)"),
        ("nodes:\n  cam:\n    watchdog: 5x\n", "robot.systemd.yml at line 3)"),
    ],
)
def test_a_wrong_key_is_named_with_its_line(project: Path, text: str, words: str) -> None:
    path = project / "robot.systemd.yml"
    path.write_text(text)
    with pytest.raises(DoraSystemdError) as caught:
        settings(USER, project / "robot.yml")
    assert caught.value.message.endswith(words)
    with pytest.raises(DoraSystemdError, match="at line "):
        check_config(USER, path)


@pytest.mark.parametrize("target", ["nothing", "robot.systemd.yml"])
def test_a_link_that_leads_nowhere_is_no_missing_file(project: Path, target: str) -> None:
    """The limits in the file would be lost; without any file there are none."""
    (project / "robot.systemd.yml").symlink_to(target)
    with pytest.raises(DoraSystemdError, match="leads to no readable file") as caught:
        settings(USER, project / "robot.yml")
    assert caught.value.code is ExitCode.BAD_INPUT
    assert "robot.systemd.yml" in caught.value.message


def test_the_user_of_the_system_is_none_of_user_scope(project: Path) -> None:
    request = StartRequest(str(project / "robot.yml"), None, {})
    read = SettingsFile(SYSTEM_FILE, place_of(Path("/etc")), b"", {"user": "root", "uv": True})
    files = read_files(request)._replace(general=(read,))
    found = settings_of(USER, files, request)
    assert (found[USER_SETTING], found[UV]) == (None, True)
    assert settings_of(SYSTEM, files, request)[USER_SETTING] == "root"


def test_settings_beside_the_dataflow(project: Path) -> None:
    (project / "robot.systemd.yml").write_text("uv: yes\n")
    assert settings(USER, project / "robot.yml")[UV] is True
    assert settings(USER, project / "robot.yml", {"uv": False})[UV] is False


ROOT_ONLY = {
    "user": "root",
    "property": "{Nice: 5}",
    "credentials": "{a: /etc/shadow}",
    "nice": "-5",
    "realtime": "20",
    "cpu_weight": "10000",
    "io_weight": "10000",
    "stop_limit": "1h",
    "machines": "{gpu: {host: gpu-box}}",
}


def test_which_settings_are_for_root_only() -> None:
    assert {one.name for one in SETTINGS if one.root_only} == ROOT_ONLY.keys()


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
@pytest.mark.parametrize("key", ROOT_ONLY)
def test_whom_to_believe(project: Path, key: str) -> None:
    beside = project / "robot.systemd.yml"
    beside.write_text(f"{key}: {ROOT_ONLY[key]}\n")
    settings(SYSTEM, project / "robot.yml")
    os.chown(beside, 65534, 65534)
    settings(USER, project / "robot.yml")
    with pytest.raises(DoraSystemdError) as caught:
        settings(SYSTEM, project / "robot.yml")
    assert caught.value.code is ExitCode.NO_PERMISSION
    os.chown(beside, 0, 0)
    os.chown(project, 65534, 65534)
    with pytest.raises(DoraSystemdError, match="nobody owns a directory above it"):
        settings(SYSTEM, project / "robot.yml")


@pytest.mark.skipif(os.getuid() != 0, reason="its files are root's")
@pytest.mark.parametrize("key", ROOT_ONLY)
@pytest.mark.parametrize(("mode", "is_refused"), [(0o666, True), (0o664, True), (0o644, False)])
def test_a_settings_file_that_others_can_write(
    project: Path, key: str, mode: int, is_refused: bool
) -> None:
    """A group counts as others, as for a hosts file."""
    beside = project / "robot.systemd.yml"
    beside.write_text(f"{key}: {ROOT_ONLY[key]}\n")
    beside.chmod(mode)
    if not is_refused:
        check_config(SYSTEM, beside)
        return
    readers: tuple[Callable[[], object], ...] = (
        lambda: settings(SYSTEM, project / "robot.yml"),
        lambda: check_config(SYSTEM, beside),
    )
    for read in readers:
        with pytest.raises(DoraSystemdError) as caught:
            read()
        assert caught.value.message == (
            f"cannot use {beside}: {key} is set there, and others than root can write to the file"
        )
        assert caught.value.code is ExitCode.NO_PERMISSION


@pytest.mark.skipif(os.getuid() != 0, reason="its files are root's")
def test_the_settings_file_of_all_dataflows_that_others_can_write(project: Path) -> None:
    """The hint does not send its reader to the file that is refused."""
    config = project / "config.yml"
    config.write_text("nice: -5\n")
    config.chmod(0o666)
    read = read_settings_file(config)
    with pytest.raises(DoraSystemdError) as caught:
        require_modest(read)
    assert caught.value.hint.startswith("give --nice on the command line, or set it in /etc/")
    with pytest.raises(DoraSystemdError) as caught:
        require_modest(read._replace(path=SYSTEM_FILE))
    assert caught.value.hint == f"chown root: {SYSTEM_FILE}; chmod go-w {SYSTEM_FILE}"


RAISING = {
    "nodes: {a: {scheduling: fifo:5}}": "nodes.a.scheduling",
    "nodes: {a: {nice: -1}}": "nodes.a.nice",
    "nodes: {a: {nice: 5, oom_score_adjust: -1}}": "nodes.a.oom_score_adjust",
    "nodes: {b: {essential: true}, a: {lock_memory: true}}": "nodes.a.lock_memory",
    "nodes: {a: {nice: 1}, b: {scheduling: 'rr:1'}}": "nodes.b.scheduling",
    "nodes: {a: {nice: 5, scheduling: idle, essential: true, cpus: 0, lock_memory: no}}": "",
    "nodes: {a: {oom_score_adjust: 9}}": "",
    "nice: -5": "nice",
    "needs: [network, ' unit:reboot.target']": "needs",
    "needs: mount:/srv": "needs",
    "needs: [network, clock]\nnodes: {a: {needs: /dev/video0}}": "",
}


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
@pytest.mark.parametrize("text", RAISING)
def test_rights_that_only_root_gives(project: Path, text: str) -> None:
    beside = project / "robot.systemd.yml"
    beside.write_text(text)
    settings(SYSTEM, project / "robot.yml")
    os.chown(beside, 65534, 65534)
    settings(USER, project / "robot.yml")
    if not RAISING[text]:
        settings(SYSTEM, project / "robot.yml")
        return
    with pytest.raises(DoraSystemdError) as caught:
        settings(SYSTEM, project / "robot.yml")
    assert caught.value.message == (
        f"cannot use {beside}: {RAISING[text]} is set there, and the file is not root's"
    )
    flag = f"--{RAISING[text]}" if RAISING[text] in ("nice", "needs") else "--node"
    assert caught.value.hint.startswith(f"give {flag} on the command line, or set it in ")
    assert caught.value.code is ExitCode.NO_PERMISSION


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
def test_a_grace_duration_of_others_is_within_stop_limit(project: Path) -> None:
    flow, beside = project / "robot.yml", project / "robot.systemd.yml"
    beside.write_text("grace_duration: 201s")
    settings(SYSTEM, flow)
    os.chown(beside, 65534, 65534)
    settings(USER, flow)
    settings(SYSTEM, flow, {"stop_limit": "6min"})
    settings(SYSTEM, flow, {"grace_duration": "1h"})
    with pytest.raises(DoraSystemdError) as caught:
        settings(SYSTEM, flow)
    assert caught.value.message == (
        f"cannot use grace_duration 3min 21s in {beside}: nodes would be killed after"
        " 5min 1s 500ms, and stop_limit is 5min"
    )
    assert "--stop-limit" in caught.value.hint
    assert caught.value.code is ExitCode.BAD_INPUT
    beside.write_text("grace_duration: infinity")
    with pytest.raises(DoraSystemdError, match="would never be killed"):
        settings(SYSTEM, flow)
    beside.write_text("grace_duration: 200s")
    settings(SYSTEM, flow)


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
def test_environment_files_of_others_are_lent(project: Path) -> None:
    flow, beside = project / "robot.yml", project / "robot.systemd.yml"
    beside.write_text("env_file: [/a, /b]\n")
    assert not settings(SYSTEM, flow).lent
    os.chown(beside, 65534, 65534)
    found = settings(SYSTEM, flow, {"env_file": ("/b", "/c")})
    assert found[ENV_FILE] == ("/a", "/b", "/b", "/c")
    assert found.lent == {"/a"}
    assert not settings(USER, flow).lent


def place_of(path: Path) -> Place:
    with reached(path) as (_, place):
        return place


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
def test_the_owner_of_the_dataflow_runs_it(project: Path) -> None:
    flow = project / "robot.yml"
    os.chown(flow, 65534, 65534)
    user = choose_user(SYSTEM, None, place_of(flow), str(project))
    assert user is not None
    assert user.pw_uid == 65534
    os.chown(flow, 4_000_000, 0)
    with pytest.raises(DoraSystemdError, match="has no name"):
        choose_user(SYSTEM, None, place_of(flow), str(project))


@pytest.mark.skipif(os.getuid() != 0, reason="gives files to somebody else")
def test_an_identity_is_not_borrowed(project: Path, tmp_path: Path) -> None:
    """The file, the directories above it and the working directory are of one owner, or root's."""
    flow, other = project / "robot.yml", tmp_path / "other"
    other.mkdir()
    os.chown(other, 1, 1)
    os.chown(flow, 65534, 65534)
    for directory, words in ((other, "owns"), (Path("/tmp"), "everybody can write")):
        with pytest.raises(DoraSystemdError, match=words) as caught:
            choose_user(SYSTEM, None, place_of(flow), str(directory))
        assert "--uid" in caught.value.hint
        assert choose_user(SYSTEM, "root", place_of(flow), str(directory)) == pwd.getpwuid(0)
    os.chown(flow, 0, 0)
    os.chown(project, 1, 1)
    with pytest.raises(DoraSystemdError, match="owns a directory above it"):
        choose_user(SYSTEM, None, place_of(flow), str(project))


@pytest.mark.parametrize("name", ["gone", f"{'n' * 256}", "robot.yml/in"])
def test_an_identity_is_not_borrowed_while_the_directory_is_away(project: Path, name: str) -> None:
    """Whoever owns it could take it away for a moment, and put it back after the check."""
    place = place_of(project / "robot.yml")._replace(uid=65534, owners=frozenset((0, 1, 65534)))
    with pytest.raises(DoraSystemdError, match="as working directory: it is not") as caught:
        choose_user(SYSTEM, None, place, str(project / name))
    assert caught.value.code is ExitCode.BAD_INPUT


def test_a_user_that_is_asked_for(project: Path) -> None:
    place = place_of(project / "robot.yml")
    for wanted in ("root", "0"):
        assert choose_user(SYSTEM, wanted, place, str(project)) == pwd.getpwuid(0)
    for wanted in ("nobody-of-that-name", "9" * 30, "-1"):
        with pytest.raises(DoraSystemdError, match="cannot find a user"):
            choose_user(SYSTEM, wanted, place, str(project))
    for scope, hint in ((SYSTEM, "see getent passwd"), (USER, "leave user out")):
        with pytest.raises(DoraSystemdError, match=r"\(user in /a\.yml\)") as caught:
            choose_user(scope, "nobody-of-that-name", place, str(project), "/a.yml")
        assert (caught.value.code, hint in caught.value.hint) == (ExitCode.BAD_INPUT, True)


def test_what_the_cell_can_reach(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = plan_of(project).options
    check_access(options)
    check_access(options._replace(dataflow="/nowhere"))  # who reads it says so
    with pytest.raises(DoraSystemdError) as caught:
        check_access(options._replace(dora="/nowhere"))
    assert caught.value.code is ExitCode.NO_DORA
    monkeypatch.setattr(os, "access", lambda path, _mode: path != options.working_directory)
    with pytest.raises(DoraSystemdError, match=f"cannot reach {project}") as caught:
        check_access(options)
    assert caught.value.code is ExitCode.NO_PERMISSION


@pytest.mark.skipif(os.getuid() != 0, reason="becomes somebody else")
def test_what_a_user_sees(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not what is behind doors that are closed for him, whatever root could see."""
    closed, opened = tmp_path / "closed dir", Path("/etc")
    closed.mkdir(mode=0o700)
    (closed / "x").write_text("secret")
    # Ours may be in a home that is closed, too.
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    with sight_of(account_of(pwd.getpwuid(65534))) as sight:
        assert not sight.exists(str(closed / "x"))
        assert not sight.is_directory(str(closed / "x"))
        with pytest.raises(PermissionError):
            sight.read(str(closed / "x"))
        assert sight.exists("/etc/passwd")
        assert sight.is_directory(str(opened))
        assert sight.is_program("/bin/sh")
        assert not sight.is_program("/etc")
        assert sight.real("/proc/self/../version") == "/proc/version"
        assert sight.read("/etc/passwd") == Path("/etc/passwd").read_bytes()
        with pytest.raises(OSError, match="No such device"):
            sight.read("/dev/null")
    with sight_of(None) as sight:
        assert sight.read(str(closed / "x")) == b"secret"


@pytest.mark.skipif(os.getuid() != 0, reason="becomes somebody else")
def test_a_child_that_is_stopped_costs_one_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its user may stop it, and slow each answer: all of them together have so much time."""
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    with sight_of(account_of(pwd.getpwuid(65534)), 0.5) as sight:
        assert not sight.exists("/" + "x" * 100_000)
        assert isinstance(sight, LentSight)
        os.kill(sight._child.pid, signal.SIGSTOP)
        for _ in range(50):
            with pytest.raises(DoraSystemdError, match="no answer"):
                sight.exists("/etc")
        assert sight._left <= 0.5


def test_a_module_that_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "module.yml")
    flow = parse_dataflow({"nodes": [{"id": "a", "module": "module.yml"}]}, str(tmp_path / "f.yml"))
    with pytest.raises(DoraSystemdError, match="it is not a regular file"):
        list(named_places(flow, Sight()))


def test_a_dynamic_node_is_started_by_hand(project: Path) -> None:
    (project / "robot.yml").write_text("nodes: [{id: cam, path: dynamic}, {id: a, path: a.py}]\n")
    (note,) = plan_of(project).notes
    assert note.startswith("start the dynamic node cam in another terminal")
    assert note.endswith('eval "$(doractl --user env robot)"')
    assert plan_of(project, network="private").notes == ()


def test_a_build_that_is_missing_or_older_than_the_dataflow(project: Path) -> None:
    flow, session = project / "robot.yml", project / "out/robot.dora-session.yaml"
    assert plan_of(project).notes == ()
    flow.write_text("nodes: [{id: a, path: a.py, build: make}]\n")
    (note,) = plan_of(project).notes
    assert note == f"no build of {flow} is found; to build it: doractl build {flow}"
    session.parent.mkdir()
    session.write_text("local_build: {node_working_dirs: {a: /x}}\n")
    os.utime(flow, (1000, 1000))
    assert plan_of(project).notes == ()
    os.utime(session, (500, 500))
    (note,) = plan_of(project, uv=True).notes
    assert note.endswith(f"newer than its last build; to build again: doractl build --uv {flow}")


def test_a_virtual_environment_that_leads_nowhere(project: Path) -> None:
    """It is refused by name: without it nodes would run with another Python."""
    venv = project / ".venv"
    venv.joinpath("bin").mkdir(parents=True)
    (venv / "pyvenv.cfg").touch()
    (venv / "bin/python").symlink_to("/nowhere/python3.11")
    with pytest.raises(DoraSystemdError, match=r"python3\.11, does not exist$") as caught:
        plan_of(project)
    assert caught.value.hint.startswith(f"remove {venv} and make it again, by uv sync")
    with pytest.raises(DoraSystemdError, match=r"python3\.11, does not exist$"):
        plan_of(project, venv=str(venv))
    make_program(project / "other/bin/python")
    other = {"VIRTUAL_ENV": f"{project}/other"}
    assert plan_of(project, other).options.venv == f"{project}/other"


def test_nodes_with_another_dora(project: Path) -> None:
    make_program(project / ".venv/bin/python")
    install(project / ".venv", "dora_rs", "1.0.1")
    install(project, "dora_rs_cli", "1.1.0")
    (warning,) = plan_of(project).warnings
    assert warning.startswith("the nodes' dora is 1.0.1, the daemon is 1.1.0: ")
    (project / "robot.yml").write_text("nodes: [{id: a, path: a}]\n")
    (project / "a").touch()
    assert plan_of(project).warnings == ()  # a program, which may be in Rust


def test_a_project_that_uv_has_not_built(project: Path) -> None:
    assert plan_of(project).warnings == ()
    (project / "uv.lock").write_text("")
    (warning,) = plan_of(project).warnings
    end = f"no .venv; to make it: doractl build {project}/robot.yml"
    assert warning == f"{project} has uv.lock and the nodes have {end}"
    assert plan_of(project, uv=True).warnings == ()
    make_program(project / ".venv/bin/python")
    assert plan_of(project).warnings == ()


def test_rust_log_of_the_owner(project: Path) -> None:
    assert plan_of(project, {"RUST_LOG": "debug"}).environment["RUST_LOG"] == "debug"


MACHINES = """nodes:
- {id: a, path: a.py, inputs: {t: dora/timer/millis/100}}
- {id: b, path: a.py, inputs: {t: dora/timer/millis/100}, deploy: {machine: gpu}}
"""


def test_a_dataflow_on_two_machines(project: Path) -> None:
    (project / "robot.yml").write_text(MACHINES)
    plan = plan_of(project, machines=("gpu=alice@gpu-box",), env=("A=1",))
    assert plan.options.placed == (Placed("b", "gpu"),)
    (member,) = plan.members
    assert member.host.destination == "alice@gpu-box"
    assert member.words == (
        *("member", str(project / "robot.yml"), "--name=robot", f"--uuid={plan.options.uuid}"),
        *(f"--head={os.uname().nodename}", "--placed=b=gpu", "--env=A=1"),
    )
    with pytest.raises(DoraSystemdError, match="node b: its machine 'gpu' is not declared"):
        plan_of(project)


def test_a_part_of_a_dataflow(project: Path) -> None:
    """A member needs no machines: it is told where the nodes run."""
    (project / "robot.yml").write_text(MACHINES)
    placed = (Placed("b", "gpu"),)
    variables = {"PATH": f"{project}/bin:/usr/bin:/bin"}
    file = str(project / "robot.yml")
    request = StartRequest(file, environment=variables, machine="gpu", placed=placed)
    options = make_plan(USER, request).options
    assert (options.placed, options.machine) == (placed, "gpu")
    flags = {"network": "private"}
    with pytest.raises(DoraSystemdError, match="the network is private"):
        make_plan(USER, request._replace(flags=flags))

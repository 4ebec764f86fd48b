"""doractl enable, disable and export: unit files that systemd itself reads."""

import json
import os
import re
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.cell.options import RunnerOptions, options_from_command
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.file import persistent_unit
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.errors import ExitCode
from dora_systemd.names import is_readable
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.refusals import IN_THE_JOURNAL

# They write to /etc, or would make the user linger.
pytestmark = pytest.mark.lab

ETC = Path("/etc/systemd/system")
TEMPLATES = Path(__file__).parents[2] / "units/templates"
NASTY = r"""x "y" 'z' $HOME ${A} %h %% é \ \n \x41 # ;"""


@pytest.fixture
def boots(cell: Cell) -> Iterator[Cell]:
    """A cell whose unit files go with it."""
    yield cell
    cell.doractl("disable", cell.name, check=False)
    cell.end()
    for path in ETC.glob(f"*.wants/{cell.unit}"):
        path.unlink()
    for root in (ETC, Path("/run/systemd/system")):
        (root / cell.unit).unlink(missing_ok=True)
        shutil.rmtree(root / f"{cell.unit}.d", ignore_errors=True)
    run("systemctl", "daemon-reload")


@pytest.fixture
def target() -> Iterator[None]:
    """dora.target, as the package has it."""
    link = ETC / "multi-user.target.wants/dora.target"
    shutil.copy(TEMPLATES / "dora.target", ETC)
    link.symlink_to(ETC / "dora.target")
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "dora.target")
    yield
    run("systemctl", "stop", "dora.target")
    link.unlink()
    (ETC / "dora.target").unlink()
    run("systemctl", "daemon-reload")


def facts(cell: Cell) -> tuple[str, str]:
    """Where the unit comes from, and whether it would start at boot."""
    return cell.show("FragmentPath"), cell.show("UnitFileState")


def variables(cell: Cell) -> list[str]:
    found: list[str] = Bus(cell.scope).read(cell.unit, ["Environment"])["Environment"]
    return found


def uuid_of(cell: Cell) -> str:
    rows = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    (row,) = [row for row in rows if row["name"] == cell.name]
    return str(row["uuid"])


def test_exported_units_need_nothing_of_us(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes(), "--env", f"SECRET={NASTY}", "--property", "Nice=5")
    before = variables(boots), uuid_of(boots)
    text = boots.doractl("export", boots.name).stdout
    boots.end()
    path = ETC / boots.unit
    path.write_text(text)
    assert run("systemd-analyze", "verify", str(path)).stderr == ""
    boots.systemctl("enable", "--now")
    assert facts(boots) == (str(path), "enabled")
    assert (variables(boots), uuid_of(boots)) == before
    assert f"SECRET={NASTY}" in before[0]
    boots.wait_exchanging()
    # enable and disable take it for what it is.
    assert "already enabled" in boots.doractl("enable", boots.name).stdout


@pytest.fixture
def neighbour() -> Iterator[Cell]:
    """Another dataflow: its start makes systemd note again where all units are."""
    cell = Cell("neighbour")
    yield cell
    cell.end()


SHORT = """
from pathlib import Path
from dora import Node
for event in Node():
    if Path("end").exists():
        break
"""
ENDS = "nodes: [{id: only, path: short.py, inputs: {tick: dora/timer/millis/50}}]\n"


@pytest.mark.parametrize("verb", ["restart", "enable", "start"])
def test_it_is_not_lost_when_it_stops(
    boots: Cell, neighbour: Cell, project: Project, verb: str
) -> None:
    flow = project.three_nodes()
    boots.start(flow)
    uuid = uuid_of(boots)
    boots.doractl("enable", boots.name)
    neighbour.start(flow)
    boots.doractl("stop", boots.name)
    assert boots.show("LoadState") == "loaded"
    if verb == "start":
        boots.start(flow)
    else:
        boots.doractl(verb, boots.name)
    assert uuid_of(boots) == uuid


@pytest.mark.parametrize("verb", ["restart", "disable", "start"])
def test_it_is_not_lost_when_it_ends_by_itself(
    boots: Cell, neighbour: Cell, project: Project, verb: str
) -> None:
    project.write("short.py", SHORT)
    flow = project.write("short.yml", ENDS)
    boots.start(flow)
    boots.doractl("enable", boots.name)
    neighbour.start(project.three_nodes())
    project.write("end", "")
    wait_for("its end", lambda: boots.show("ActiveState") == "inactive")
    (project.root / "end").unlink()
    if verb == "start":
        boots.start(flow)
    else:
        boots.doractl(verb, boots.name)
    assert (ETC / boots.unit).exists() == (verb != "disable")


@pytest.mark.usefixtures("target")
def test_a_running_dataflow_is_enabled_and_runs_on(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes(), "--env", f"SECRET={NASTY}")
    pids, before = boots.all_pids(), (variables(boots), uuid_of(boots))
    done = boots.doractl("enable", boots.name)
    path = ETC / boots.unit
    assert done.stdout == (f"Dataflow enabled: {before[1]} ({boots.name})\nUnit file: {path}\n")
    assert boots.all_pids() == pids
    assert (ETC / "dora.target.wants" / boots.unit).is_symlink()
    assert run("systemd-analyze", "verify", str(path)).stderr == ""
    header, row = boots.doractl("list").stdout.splitlines()
    assert (header.split()[-1], row.split()[-1]) == ("BOOT", "yes")
    # With its own tools: systemd has no reason to hold the transient unit.
    boots.systemctl("stop")
    boots.systemctl("start")
    assert facts(boots) == (str(path), "enabled")
    assert (variables(boots), uuid_of(boots)) == before
    boots.wait_exchanging()


@pytest.mark.usefixtures("target")
@pytest.mark.warns("Main process exited", "Failed with result", "supervisor process was killed")
def test_a_stop_in_the_first_moments_of_a_life(boots: Cell, project: Project) -> None:
    """It has no handler for SIGTERM yet; the crash before that is not how it has ended."""
    boots.start(project.three_nodes(), "--enable")
    boots.systemctl("kill", "--signal=KILL", "--kill-whom=main")
    wait_for("it has failed", lambda: boots.show("ActiveState") == "failed")
    assert ("dataflow-failed", "") in boots.events()
    boots.systemctl("start", "--no-block")
    wait_for("a process", lambda: boots.show("MainPID") != "0")
    boots.systemctl("stop")
    rows = json.loads(boots.doractl("list", "--all", "-o", "json").stdout)
    (listed,) = [row["status"] for row in rows if row["name"] == boots.name]
    explained = json.loads(boots.doractl("why", boots.name, "-o", "json").stdout)["status"]
    assert (listed, explained) == ("Stopped", "Stopped")
    assert boots.events()[-1] == ("dataflow-stopped", "")


@pytest.mark.warns("Main process exited", "Failed with result", "supervisor process was killed")
def test_a_stop_that_calls_a_restart_off(boots: Cell, project: Project) -> None:
    """Nothing of it runs from the kill on, and every view says so."""
    policy = ("--restart-policy", "always", "--restart-delay", "60s", "--max-restart-delay", "60s")
    boots.start(project.three_nodes(), "--enable", *policy)
    boots.systemctl("kill", "--signal=KILL", "--kill-whom=main")
    wait_for("its restart is due", lambda: boots.show("SubState") == "auto-restart")
    assert said(boots, "list") == said(boots, "why") == ("Restarting", None)
    boots.doractl("stop", boots.name)
    assert boots.show("LoadState") == "loaded"
    killed = ("Failed", "the supervisor process was killed (SIGKILL)")
    assert said(boots, "list") == killed
    assert said(boots, "why")[0] == "Failed"


def said(cell: Cell, verb: str) -> tuple[str, str | None]:
    """The status that `list` or `why` gives of a dataflow, and its text."""
    found = json.loads(cell.doractl(verb, cell.name, "-o", "json", check=False).stdout)
    return found["status"], found["text"]


@pytest.mark.usefixtures("target")
def test_a_reload_in_between_changes_nothing(boots: Cell, project: Project) -> None:
    """The target holds the transient unit then; doractl has it forgotten."""
    flow = project.three_nodes()
    boots.start(flow)
    uuid = uuid_of(boots)
    boots.doractl("enable", boots.name)
    pids = boots.all_pids()
    run("systemctl", "daemon-reload")
    assert boots.all_pids() == pids
    boots.doractl("stop", boots.name)
    assert facts(boots) == (str(ETC / boots.unit), "enabled")
    row = json.loads(boots.doractl("list", "--all", "-o", "json").stdout)[0]
    assert (row["status"], row["enabled"], row["uuid"]) == ("Stopped", True, uuid)
    assert boots.doractl("list", boots.name, check=False).returncode == ExitCode.NOT_RUNNING
    # The same again is the enabled one.
    assert f"Dataflow started: {uuid}\n" in boots.start(flow).stdout
    assert facts(boots) == (str(ETC / boots.unit), "enabled")


_KILLED = """
import os, signal, sys
def hook(event, arguments):
    if event == "os.remove" and "/system.control/" in str(arguments[0]):
        os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
from dora_systemd.cli.main import main
main()
"""
"""A doractl that is killed when the unit file of an ended transient unit is about to count."""


@pytest.mark.usefixtures("target")
def test_a_killed_stop_leaves_it_enabled(boots: Cell, project: Project) -> None:
    flow = project.three_nodes()
    boots.start(flow)
    boots.doractl("enable", boots.name)
    run("systemctl", "daemon-reload")
    words = (sys.executable, "-c", _KILLED, "--system", "stop", boots.name)
    assert run(*words, check=False).returncode == -signal.SIGKILL
    assert run("systemctl", "is-enabled", boots.unit).stdout == "enabled\n"
    boots.start(flow)
    assert facts(boots) == (str(ETC / boots.unit), "enabled")
    assert boots.show("WantedBy") == "dora.target"


@pytest.mark.parametrize("way", ["started", "enabled", "both"])
def test_blanks_in_paths_that_are_mounted(boots: Cell, project: Project, way: str) -> None:
    """systemd 257 writes mounts of a transient unit unquoted, and reads others at a reload."""
    place, source = Path("/var/tmp/a b"), Path("/srv/x  y")
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(project.three_nodes().parent, place)
    source.mkdir(exist_ok=True)
    mount = ["--property", f'BindReadOnlyPaths="{source}":"/opt/t t"'] if way != "started" else []
    flag = ["--enable"] if way == "both" else []
    said = boots.start(place / "dataflow.yml", *flag, *mount).stderr
    assert "cannot hide what is around /var/tmp/a b" in said
    if way == "enabled":
        boots.doractl("enable", boots.name)
        # Nobody can help the transient unit: the mount that --property asks for is in its text.
        boots.doractl("stop", boots.name)
    run("systemctl", "daemon-reload")
    boots.doractl("restart", boots.name)
    boots.wait_exchanging()
    if way != "started":
        path = ETC / boots.unit
        assert run("systemd-analyze", "verify", str(path)).stderr == ""
        assert boots.show("BindReadOnlyPaths") == "/srv/x  y:/opt/t t:rbind"
    shutil.rmtree(place)
    source.rmdir()


def test_start_and_enable(boots: Cell, project: Project) -> None:
    flow = project.three_nodes()
    first = boots.start(flow, "--enable", "--env", "A=1").stdout
    assert facts(boots) == (str(ETC / boots.unit), "enabled")
    assert boots.show("WantedBy") == "multi-user.target"
    uuid = uuid_of(boots)
    assert uuid in first
    boots.doractl("stop", boots.name)
    refused = boots.start(flow, check=False)
    assert refused.returncode == ExitCode.NAME_IN_USE
    assert "enabled with other settings" in refused.stderr
    assert uuid in boots.start(flow, "--enable", "--env", "A=2").stdout
    assert "A=2" in variables(boots)


def test_what_a_dry_run_shows_is_what_is_written(boots: Cell, project: Project) -> None:
    flow = project.three_nodes()
    shown = boots.start(flow, "--enable", "--dry-run").stdout
    assert not (ETC / boots.unit).exists()
    boots.start(flow, "--enable")
    uuid, written = uuid_of(boots), (ETC / boots.unit).read_text()
    assert re.sub(r"[0-9a-f-]{36}", uuid, shown).endswith(written)
    assert run("systemd-analyze", "verify", str(ETC / boots.unit)).stderr == ""


@pytest.fixture
def leaving() -> Iterator[tuple[str, ...]]:
    """How a command is run as a user whose manager ends when he logs out."""
    run("loginctl", "disable-linger", "bob")
    runtime = "XDG_RUNTIME_DIR=/run/user/1001"
    session = (
        "systemd-run",
        "--collect",
        "--quiet",
        "--pipe",
        "--wait",
        "-p",
        "PAMName=login",
        "-p",
        "User=bob",
    )
    yield (*session, f"--setenv=PATH={os.environ['PATH']}", f"--setenv={runtime}")
    run("loginctl", "enable-linger", "bob")
    wait_for("his manager", lambda: Path("/run/user/1001/bus").exists())


def test_a_user_lingers_from_then_on(leaving: tuple[str, ...], project: Project) -> None:
    flow = project.three_nodes()
    start = (*leaving, "doractl", "start", str(flow), "--name", "leaving")
    again = "doractl stop leaving && doractl start leaving && doractl enable leaving"
    first = f"doractl start {flow} --name leaving"
    done = run(*leaving, "sh", "-c", f"{first} && {again}")
    assert "Dataflow enabled: " in done.stdout
    assert done.stderr.splitlines() == [
        "doractl: it ends when bob logs out; "
        "to keep it running, as root: loginctl enable-linger bob",
        "doractl: lingering is now on for bob: dataflows start at boot, not at login",
    ]
    assert run("loginctl", "show-user", "-p", "Linger", "--value", "bob").stdout == "yes\n"
    # The session that he started it in has ended, and nothing was said to lose.
    assert run(*start, check=False).returncode == ExitCode.NAME_IN_USE
    path = Path("/home/bob/.config/systemd/user/dora-leaving.service")
    assert path.read_text().endswith("\n[Install]\nWantedBy=default.target\n")
    run(*leaving, "doractl", "stop", "leaving")
    assert run(*leaving, "systemctl", "--user", "is-enabled", path.name).stdout == "enabled\n"
    run(*leaving, "doractl", "disable", "leaving")
    assert not path.exists()


def test_drop_ins_work(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes(), "--enable")
    run("systemctl", "edit", "--stdin", boots.unit, input="[Service]\nNice=7\n")
    boots.doractl("restart", boots.name)
    assert boots.show("Nice") == "7"
    assert "Nice=7" in boots.systemctl("cat")
    assert "\nNice=7\n" in boots.doractl("export", boots.name).stdout
    shutil.rmtree(ETC / f"{boots.unit}.d")


def test_disabled_while_it_runs(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes(), "--enable")
    pids = boots.all_pids()
    assert "Dataflow disabled: " in boots.doractl("disable", boots.name).stdout
    assert boots.all_pids() == pids
    assert not (ETC / boots.unit).exists()
    assert boots.show("KillMode") == "mixed"
    assert not json.loads(boots.doractl("list", "-o", "json").stdout)[0]["enabled"]
    again = boots.doractl("disable", boots.name)
    assert (again.returncode, again.stdout.split(":")[0]) == (0, "Dataflow not enabled")
    boots.doractl("stop", boots.name)
    boots.start(project.root / "dataflow.yml")
    assert boots.show("Transient") == "yes"


def test_run_after_it_was_disabled_and_stopped(boots: Cell, project: Project) -> None:
    """The unit file moves to /run while it runs, and stays there."""
    project.write("node.py", "from dora import Node\nNode()\n")
    flow = project.three_nodes()
    boots.start(flow)
    for verb in ("enable", "stop", "restart", "disable", "stop"):
        boots.doractl(verb, boots.name)
    short = project.write("short.yml", "nodes: [{id: one, path: node.py}]\n")
    boots.doractl("run", str(short), "--name", boots.name)
    assert boots.is_gone
    assert not (Path("/run/systemd/system") / boots.unit).exists()


def test_enabled_and_disabled_again_while_it_runs(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes())
    boots.doractl("enable", boots.name)
    assert "already enabled" in boots.doractl("enable", boots.name).stdout
    boots.doractl("disable", boots.name)
    boots.doractl("stop", boots.name)
    assert not list(ETC.rglob(boots.unit))
    assert boots.show("LoadState") == "not-found"


@pytest.mark.parametrize("verb", ["enable", "disable", "export"])
def test_unknown_dataflows(verb: str) -> None:
    for name in ("nobody", "no/body", "gateway", ""):
        done = run("doractl", verb, name, check=False)
        assert (done.returncode, done.stdout) == (ExitCode.NOT_FOUND, "")
        assert len(done.stderr.splitlines()) == 2


def test_a_foreign_unit_file_stays(boots: Cell, project: Project) -> None:
    flow = project.three_nodes()
    boots.start(flow)
    path = ETC / boots.unit
    path.write_text("[Service]\nExecStart=/bin/true\n")
    done = boots.doractl("enable", boots.name, check=False)
    assert done.returncode == ExitCode.NAME_IN_USE
    assert done.stderr.startswith(f"doractl: cannot use {path}: it already exists")
    boots.end()
    assert boots.start(flow, "--enable", check=False).returncode == ExitCode.NAME_IN_USE
    assert path.read_text() == "[Service]\nExecStart=/bin/true\n"


STRANGE = {
    "foreign": "[Service]\nExecStart=/bin/true\n",
    "no-unit": "hello [[[\n",
    "empty": "",
}


@pytest.mark.warns(
    *(f"dora-{name}.service" for name in ("no-unit", "empty", "half", "cut", "gone"))
)
def test_broken_and_foreign_unit_files(boots: Cell, project: Project) -> None:
    """They are told from ours, none is touched, and nobody else is bothered."""
    flow = project.three_nodes()
    boots.start(flow)
    exported = boots.doractl("export", boots.name).stdout
    texts = {
        **STRANGE,
        "of-another": exported,
        "half": exported.partition("NotifyAccess")[0],
        "cut": exported.partition("--uuid")[0],
    }
    paths = {name: ETC / f"dora-{name}.service" for name in (*texts, "masked", "gone", "directory")}
    for name, text in texts.items():
        paths[name].write_text(text)
    paths["masked"].symlink_to("/dev/null")
    paths["gone"].symlink_to("/nowhere")
    paths["directory"].mkdir()
    before = list_directory(ETC)
    run("systemctl", "daemon-reload")
    try:
        assert [row["name"] for row in rows_of(boots)] == [boots.name]
        assert run("doractl", "doctor", check=False).stderr == ""
        for name in paths:
            refused(boots, ExitCode.NAME_IN_USE, "start", str(flow), "--enable", "--name", name)
            refused(boots, ExitCode.NOT_FOUND, "enable", name)
            refused(boots, ExitCode.NOT_FOUND, "disable", name)
        assert list_directory(ETC) == before
    finally:
        for path in paths.values():
            path.rmdir() if path.is_dir() else path.unlink()
    boots.wait_exchanging()


def refused(cell: Cell, code: ExitCode, *words: str) -> None:
    """One line and a hint."""
    done = cell.doractl(*words, check=False)
    assert (done.returncode, done.stdout) == (code, ""), (words, done.stderr)
    first, second = done.stderr.splitlines()
    assert first.startswith(("doractl: cannot ", "doractl: no dataflow named "))
    assert second.startswith("hint: ")


def rows_of(cell: Cell) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(cell.doractl("list", "-o", "json").stdout)
    return rows


def list_directory(place: Path) -> dict[str, str]:
    """Every path below it, with what a file has in it."""
    found = sorted(place.rglob("*"))
    return {str(path): path.read_text() if path.is_file() else "" for path in found}


@pytest.mark.parametrize(
    "room", ["size=4k", "nr_inodes=3"], ids=["no-byte-left", "no-room-for-the-link"]
)
def test_a_full_etc(boots: Cell, project: Project, room: str) -> None:
    """One clear line, and nothing is left behind."""
    flow = project.three_nodes()
    boots.start(flow)
    run("mount", "-t", "tmpfs", "-o", f"{room},mode=755", "tmpfs", str(ETC))
    try:
        (ETC / "fill").write_bytes(b"x" * 4096)
        done = boots.doractl("enable", boots.name, check=False)
        other = boots.doractl("start", str(flow), "--enable", "--name", "other", check=False)
        assert [path.name for path in ETC.iterdir()] == ["fill"]
    finally:
        run("umount", str(ETC))
    for one, unit in ((done, boots.unit), (other, "dora-other.service")):
        assert one.returncode == ExitCode.FAILURE
        line = one.stderr.splitlines()[0]
        assert line.startswith("doractl: cannot ")
        assert unit in line
        assert "No space left on device" in line or "systemd made no link" in line
    assert [row["name"] for row in rows_of(boots)] == [boots.name]
    boots.wait_exchanging()


def test_users_may_not(boots: Cell, project: Project) -> None:
    boots.start(project.three_nodes())
    command = ("runuser", "-u", "alice", "--", "doractl", "--system", "enable", boots.name)
    done = run(*command, check=False)
    assert done.returncode == ExitCode.NO_PERMISSION
    assert "use sudo" in done.stderr


@pytest.mark.warns("no such file", "exit", "Failed", "failed", "cannot")
def test_a_dataflow_file_that_is_gone(boots: Cell, project: Project) -> None:
    """The boot goes on: the target does not wait, and does not need it."""
    flow = project.three_nodes()
    boots.start(flow, "--enable")
    boots.doractl("stop", boots.name)
    flow.unlink()
    boots.systemctl("start", check=False)
    wait_for("it has failed", lambda: boots.show("ActiveState") == "failed")
    assert boots.show("ExecMainStatus") == "78"
    assert str(flow) in boots.show("StatusText")
    row = json.loads(boots.doractl("list", "--all", "-o", "json").stdout)[0]
    assert (row["status"], row["enabled"]) == ("Failed", True)


values = st.text(st.characters(exclude_categories=["Cc"]), max_size=40).filter(is_readable)
paths = st.text(max_size=20).filter(is_readable)


@settings(
    deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(texts=st.lists(values, max_size=30), path=paths)
def test_systemd_reads_what_was_meant(boots: Cell, texts: list[str], path: str) -> None:
    """Quotes, backslashes, "%" and "$" in secrets and in paths."""
    name, environment = boots.name, {f"V{place}": text for place, text in enumerate(texts)}
    uuid = "550e8400-e29b-41d4-a716-446655440000"
    told = RunnerOptions(name, uuid, f"/{path}", "/srv", "/usr/bin/dora")
    context = UnitContext("/usr/bin/python3", False, "dora", environment)
    unit = format_unit(unit_properties(told, context, resolve_settings({}, {}, [])))
    (ETC / boots.unit).write_text(persistent_unit([unit], told, False, "dora.target"))
    bus = Bus(boots.scope)
    bus.reload()
    found = bus.read(boots.unit, ["LoadState", "Environment", "ExecStart"])
    assert found["LoadState"] == "loaded"
    assert found["Environment"] == [f"{key}={text}" for key, text in environment.items()]
    assert options_from_command(found["ExecStart"][0][1]) == told


@pytest.mark.warns(*IN_THE_JOURNAL)
def test_a_dora_that_is_gone_at_the_next_boot_is_no_reason_to_try_again(
    boots: Cell, project: Project
) -> None:
    dora = project.write("dora", f'#!/bin/sh\nexec {shutil.which("dora")} "$@"\n')
    dora.chmod(0o755)
    options = (f"--dora={dora}", "--restart-policy", "on-failure")
    boots.start(project.three_nodes(), *options)
    boots.doractl("enable", boots.name)
    boots.doractl("stop", boots.name)
    dora.unlink()
    assert run("systemctl", "start", boots.unit, check=False).returncode == 1
    assert boots.show("ActiveState") == "failed"
    assert (boots.show("ExecMainStatus"), boots.show("NRestarts")) == ("72", "0")
    assert f"cannot run the dora command {dora}" in boots.doractl("why", boots.name).stdout

"""Other releases of Debian: the packages installed by apt, and used."""

import json
import pwd
import re
import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from dora_systemd.decisions.properties.table import TABLE_VERSION
from tests.deb.packages import install
from tests.platforms.table import HERE
from tests.system.cells import Project, dora_processes, run, wait_for, wait_no_process
from tests.system.ports import reserve_ports
from tests.system.recorders import COUNTING, counted
from tests.system.tolerated import is_tolerated

LAB = "/opt/lab"
"""The environment of the tests, which is that of the nodes too."""
USERS = ("root", "alice")
RECORD = ("--black-box", "yes", "--record", "yes")
PATH = "/usr/sbin:/usr/bin:/sbin:/bin"


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """There is no network here: nothing else may be needed."""
    reserve_ports()
    install()


@pytest.fixture
def flow() -> Iterator[Path]:
    root = Path(tempfile.mkdtemp(prefix="flow-", dir="/var/tmp"))
    root.chmod(0o755)
    yield Project(root / "project").three_nodes()
    for user in USERS:
        doractl(user, "disable", "robot", check=False)
        doractl(user, "stop", "robot", check=False)
    shutil.rmtree(root)
    wait_no_process()


def as_user(user: str, *words: str, check: bool = True) -> CompletedProcess[str]:
    """A command of `user`, who has nothing but what Debian gives him."""
    entry = pwd.getpwnam(user)
    env = {"PATH": PATH, "LANG": "C.UTF-8", "HOME": entry.pw_dir}
    env["XDG_RUNTIME_DIR"] = f"/run/user/{entry.pw_uid}"
    if user == "root":
        return run(*words, env=env, cwd="/", check=check)
    switch = ("setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups")
    return run(*switch, *words, env=env, cwd="/", check=check)


def doractl(user: str, *words: str, check: bool = True) -> CompletedProcess[str]:
    return as_user(user, "doractl", *words, check=check)


def start(user: str, flow: Path, *words: str) -> CompletedProcess[str]:
    # Whoever names the host's network is not told of the other users of the machine.
    network = () if "--network" in words else ("--network", "host")
    command = ("start", str(flow), "--name", "robot", "--venv", LAB, *network, *words)
    return doractl(user, *command)


def systemctl(user: str, verb: str, *words: str) -> str:
    scope = "--system" if user == "root" else "--user"
    return as_user(user, "systemctl", scope, verb, "dora-robot.service", *words).stdout


def show(user: str, name: str) -> str:
    return systemctl(user, "show", "--value", "--property", name).strip()


def row(user: str) -> dict[str, Any]:
    (found,) = json.loads(doractl(user, "list", "-o", "json").stdout)
    return dict(found)


def lines(user: str, node: str) -> list[str]:
    return doractl(user, "logs", "robot", "--node", node, "-o", "cat").stdout.splitlines()


def group(user: str) -> Path:
    return Path(f"/sys/fs/cgroup{show(user, 'ControlGroup')}")


def warnings(cursor: str) -> list[str]:
    """What systemd and we have warned of since then; dora's own warnings are not meant."""
    command = ("journalctl", "-o", "json", "--priority=warning", f"--after-cursor={cursor}")
    found = [json.loads(line) for line in run(*command).stdout.splitlines()]
    ours = [str(one["MESSAGE"]) for one in found if "DORA_NODE" not in one and "dora" in str(one)]
    return [one for one in ours if not is_tolerated(one)]


def cursor() -> str:
    shown = run("journalctl", "-n", "0", "--show-cursor").stdout
    return shown.rpartition("-- cursor: ")[2].strip()


def test_versions() -> None:
    versions = json.loads(doractl("alice", "version", "-o", "json").stdout)
    assert versions["systemd"].startswith(HERE.systemd)
    assert versions["python"].startswith(HERE.python)
    assert versions["dora"] == "1.1.0"


@pytest.mark.parametrize("user", USERS)
def test_doctor_says_what_it_lacks(user: str) -> None:
    done = doractl(user, "doctor", "-o", "json")
    found = {one["topic"]: one for one in json.loads(done.stdout)}
    assert done.stderr == ""
    assert found["systemd"]["state"] == ("note" if HERE.lacks else "ok")
    named = found.get("properties", {"text": ""})["text"]
    assert set(HERE.lacks) <= set(named.replace(",", "").split())
    assert len(found["systemd"]["text"]) < 70
    assert found["dora"]["text"] == "/usr/bin/dora, version 1.1.0"


def test_its_units_are_understood() -> None:
    units = [str(path) for path in Path("/usr/lib/systemd/system").glob("dora*.*")]
    units = [unit for unit in units if not unit.endswith(".d")]
    assert len(units) == 7
    assert run("systemd-analyze", "verify", "--man=no", *units).stderr == ""
    assert "dora.target" in run("systemctl", "list-dependencies", "multi-user.target").stdout
    assert pwd.getpwnam("dora").pw_shell == "/usr/sbin/nologin"


@pytest.mark.parametrize("user", USERS)
def test_a_life(user: str, flow: Path) -> None:
    before = cursor()
    assert start(user, flow).stderr == ""
    shown = row(user)
    assert (shown["name"], shown["status"], shown["nodes_alive"]) == ("robot", "Running", 3)
    wait_for("the sink prints", lambda: len(lines(user, "sink")) > 2)
    groups = {path.name for path in group(user).iterdir() if path.is_dir()}
    assert groups == {"supervisor", "node-source", "node-doubler", "node-sink"}
    assert "3/3 nodes running" in systemctl(user, "status", "--no-pager")
    pids = group(user) / "node-doubler/cgroup.procs"
    pid = pids.read_text()
    doractl(user, "node", "restart", "robot", "doubler")
    wait_for("another doubler", lambda: pids.read_text() not in (pid, ""))
    assert "Dataflow stopped:" in doractl(user, "stop", "robot").stdout
    wait_for("it is gone", lambda: not dora_processes())
    assert warnings(before) == []


def test_a_network_of_its_own_and_a_directory_of_its_own(flow: Path) -> None:
    assert start("root", flow, "--network", "private", "--debug").stderr == ""
    (pid,) = (group("root") / "node-sink/cgroup.procs").read_text().split()
    seen = run("nsenter", "--target", pid, "--mount", "ls", "/run/dora-systemd").stdout
    assert seen == "robot\n"
    doractl("root", "node", "restart", "robot", "sink")
    wait_for("it runs", lambda: row("root")["nodes_alive"] == 3)
    assert "doubler" in doractl("root", "dora", "robot", "--", "node", "list").stdout
    doractl("root", "up")
    script = 'eval "$(doractl env)"; dora node list'
    assert "doubler" in as_user("root", "bash", "-c", script).stdout
    doractl("root", "reload", "robot")
    doractl("root", "restart", "robot")
    doractl("root", "destroy")


@pytest.mark.skipif("PrivatePIDs" not in HERE.lacks, reason="this systemd has it")
@pytest.mark.parametrize("user", USERS)
def test_what_is_left_out_is_named(user: str, flow: Path) -> None:
    words = ("--restart-policy", "on-failure", "--property", "PrivatePIDs=yes")
    said = start(user, flow, *words).stderr.splitlines()
    assert said == [
        f"doractl: {name}= is left out: systemd 252 lacks it, version {version} has it"
        for name, version in (("PrivatePIDs", 257),)
    ]
    assert (show(user, "Restart"), show(user, "ActiveState")) == ("on-failure", "active")


@pytest.mark.skipif(int(HERE.systemd) <= TABLE_VERSION, reason="doractl knows all of it")
@pytest.mark.parametrize("user", USERS)
def test_what_only_a_newer_systemd_has(user: str, flow: Path) -> None:
    new = {"FileDescriptorStorePreserve": "on-success", "MemoryTHP": "disable"}
    before = cursor()
    words = [word for key, value in new.items() for word in ("--property", f"{key}={value}")]
    said = start(user, flow, "--enable", *words).stderr.splitlines()
    noted = [line.partition("= is passed on")[0] for line in said]
    assert noted == [f"doractl: {key}" for key in new]
    assert {key: show(user, key) for key in new} == new
    doractl(user, "restart", "robot")
    assert {key: show(user, key) for key in new} == new
    assert warnings(before) == []
    doractl(user, "stop", "robot")
    wrong = ("start", str(flow), "--name", "wrong", "--venv", LAB, "--network", "host")
    for one, word in (("MemoryTHP=never-ever", "MemoryTHP"), ("NoSuchThing=1", "no such property")):
        done = doractl(user, *wrong, "--property", one, check=False)
        assert done.returncode != 0
        assert word in done.stderr.splitlines()[-2 if "hint: " in done.stderr else -1], done.stderr
    assert "wrong" not in doractl(user, "list", "--all").stdout


def test_a_system_account_is_told_how_to_get_a_manager(flow: Path) -> None:
    """Since systemd 258 no login gives it one."""
    run("userdel", "games", check=False)
    run("useradd", "--system", "--create-home", "games")
    done = doractl("games", "list", check=False)
    assert "hint: games is a system account" in done.stderr
    (remedy,) = re.findall(r"as root: (loginctl .*)", done.stderr)
    as_user("root", *remedy.split())
    place = f"/run/user/{pwd.getpwnam('games').pw_uid}/systemd/private"
    wait_for("its manager", lambda: Path(place).exists())
    assert start("games", flow).stdout.startswith("Dataflow started: ")
    assert row("games")["status"] == "Running"
    doractl("games", "stop", "robot")
    run("loginctl", "disable-linger", "games")


TELL = """#!/bin/sh
env | grep ^DORA_NOTICE_ >"$OUT/new"
mv "$OUT/new" "$OUT/notice"
"""


@pytest.mark.parametrize("user", USERS)
def test_a_notice_of_a_failure(user: str, flow: Path) -> None:
    """systemd 252 and 262 start the unit that sends it, and copy the sandbox of the nodes."""
    tell = Project(flow.parent, is_new=False).write("tell.sh", TELL)
    tell.chmod(0o755)
    (place := flow.parent / "out").mkdir()
    place.chmod(0o777)
    start(user, flow, f"--on-failure={tell}", f"--writable={place}", f"--env=OUT={place}")
    listed = json.loads(doractl(user, "list", "robot", "-o", "json").stdout)
    (pid,) = [one["pid"] for one in listed["nodes"] if one["node"] == "sink"]
    run("kill", "-KILL", str(pid))
    notice = place / "notice"
    wait_for("the notice", notice.exists)
    assert "DORA_NOTICE_EVENT=node-given-up\n" in notice.read_text()
    assert "DORA_NOTICE_NODE=sink\n" in notice.read_text()


def recorded(bundle: Path) -> list[int]:
    """The numbers that node.py has sent, by the recording of a bundle."""
    with tarfile.open(bundle) as archive:
        names = archive.getnames()
        file = archive.extractfile("recording.mcap") if "recording.mcap" in names else None
        return counted(file.read()) if file else []


@pytest.mark.parametrize("user", USERS)
def test_a_failure_leaves_the_last_messages(user: str, flow: Path) -> None:
    """Before systemd 254 the memory of the recorder is gone when the unit has failed."""
    project = Project(flow.parent, is_new=False)
    project.write("node.py", COUNTING)
    node = "{id: talker, path: node.py, inputs: {t: dora/timer/millis/20}, outputs: [count]}"
    start(user, project.write("alone.yml", f"nodes: [{node}]\n"), *RECORD)
    file = Path(tempfile.mkdtemp(prefix="bundle-", dir="/var/tmp")) / "robot.tar"
    shutil.chown(file.parent, user)

    def is_recorded() -> bool:
        doractl(user, "bundle", "robot", "-o", str(file))
        return bool(recorded(file))

    wait_for("it is recorded", is_recorded)
    shutil.rmtree(file.parent)
    project.write("fail", "")
    wait_for("it has failed", lambda: show(user, "ActiveState") == "failed")

    def written() -> list[dict[str, Any]]:
        return list(json.loads(doractl(user, "bundles", "robot", "-o", "json").stdout))

    def of_failure() -> list[dict[str, Any]]:
        """A slow machine has one of the given-up node before that."""
        return [one for one in written() if one["event"] == "failed"]

    (final,) = wait_for("its bundle", of_failure, 60)
    last = max(int(one) for one in lines(user, "talker") if one.isdigit())
    assert last - 5 <= recorded(Path(final["file"]))[-1] <= last
    for one in written():
        doractl(user, "bundles", "robot", "--remove", one["bundle"])


@pytest.mark.parametrize("user", USERS)
def test_a_killed_daemon_is_followed_by_a_new_start(user: str, flow: Path) -> None:
    start(user, flow, "--restart-policy", "on-failure")
    uuid, runner = row(user)["uuid"], show(user, "MainPID")
    pids = (group(user) / "supervisor/cgroup.procs").read_text().split()
    (daemon,) = (pid for pid in pids if "daemon" in Path(f"/proc/{pid}/cmdline").read_text())
    run("kill", "-KILL", daemon)
    wait_for("another runner", lambda: show(user, "MainPID") not in ("0", runner))
    wait_for("it runs", lambda: row(user)["status"] == "Running")
    assert row(user)["uuid"] == uuid
    assert show(user, "NRestarts") == "1"


@pytest.mark.parametrize("user", USERS)
def test_enabled_and_disabled(user: str, flow: Path) -> None:
    start(user, flow)
    uuid, pid = row(user)["uuid"], show(user, "MainPID")
    assert doractl(user, "enable", "robot").stdout.startswith(f"Dataflow enabled: {uuid}")
    assert show(user, "MainPID") == pid
    unit = systemctl(user, "show", "--value", "--property=FragmentPath")
    assert row(user)["enabled"], unit
    systemctl(user, "stop")
    before = cursor()
    systemctl(user, "start")
    wait_for("it runs", lambda: row(user)["status"] == "Running")
    assert (row(user)["uuid"], show(user, "UnitFileState")) == (uuid, "enabled")
    assert warnings(before) == [], "systemd knows all that is in the file"
    assert "Dataflow disabled:" in doractl(user, "disable", "robot").stdout
    assert not row(user)["enabled"]


@pytest.mark.parametrize("user", USERS)
def test_a_reload_of_systemd_changes_nothing(user: str, flow: Path) -> None:
    """As the installation of any package makes one."""
    start(user, flow, "--restart-policy", "on-failure")
    before, argv = row(user), show(user, "ExecStart")
    scope = "--system" if user == "root" else "--user"
    said = cursor()
    as_user(user, "systemctl", scope, "daemon-reload")
    assert row(user)["uuid"] == before["uuid"]
    assert show(user, "ExecStart").partition(";")[0] == argv.partition(";")[0]
    doractl(user, "restart", "robot")
    assert row(user)["status"] == "Running"
    assert warnings(said) == []


@pytest.mark.skipif(HERE.keeps_commands, reason="this systemd keeps it")
def test_what_would_not_outlive_a_reload_is_refused(flow: Path) -> None:
    """Such a path is for a later systemd, or for a unit file."""
    place = flow.parent.rename(flow.parent.with_name("$HOME"))
    command = ("start", str(place / flow.name), "--name", "robot", "--venv", LAB)
    done = doractl("root", *command, check=False)
    assert done.returncode == 2
    assert "over a reload of systemd 252" in done.stderr
    doractl("root", *command, "--enable")
    assert row("root")["status"] == "Running"


@pytest.mark.parametrize("user", USERS)
def test_start_and_enable(user: str, flow: Path) -> None:
    before = cursor()
    assert start(user, flow, "--enable").stderr == ""
    assert (row(user)["enabled"], row(user)["status"]) == (True, "Running")
    assert warnings(before) == []


@pytest.mark.skipif(HERE.has_watchfiles, reason="there is python3-watchfiles")
def test_hot_reload_needs_what_this_debian_does_not_have(flow: Path) -> None:
    done = doractl("root", "start", str(flow), "--venv", LAB, "--hot-reload", check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines() == [
        "doractl: cannot use hot reload: this system has no Python package watchfiles",
        "hint: doractl reload NAME takes up changes without it",
    ]


@pytest.mark.parametrize("user", USERS)
def test_the_gateway(user: str, flow: Path) -> None:
    start(user, flow)
    assert "  ✓ Daemon ready\n" in doractl(user, "up").stdout
    script = 'eval "$(doractl env)"; dora list'
    assert "robot" in as_user(user, "bash", "-c", script).stdout
    done = doractl(user, "destroy")
    assert "  ✓ robot stopped\n" in done.stdout
    assert done.stdout.endswith("Nothing is left: no process in dora.slice.\n")
    assert not Path("/run/dora-systemd-gateway").exists()
    assert not Path("/run/user/1000/dora-systemd-gateway").exists()

"""doractl -H: other hosts by ssh. Here they are this machine, as root and as alice."""

import json
import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.sshds import HERE, Servers, sessions, shell_of, three_hosts
from tests.system.terminal import Screen, Tmux, shown

pytestmark = pytest.mark.lab

HOSTILE = "x';touch /tmp/remote-was-here;echo '\\"


@pytest.fixture
def servers() -> Iterator[Servers]:
    """See three_hosts()."""
    with three_hosts() as servers:
        yield servers


def doractl(*words: str) -> subprocess.CompletedProcess[str]:
    return run("doractl", *words, check=False)


@pytest.mark.usefixtures("servers")
def test_one_host(cell: Cell, project: Project) -> None:
    """What a host prints, and its exit statuses, as they are there."""
    flow = str(project.three_nodes())
    given = ("--name", cell.name, "--uid", "alice")
    started = run("doractl", "-H", "base", "start", flow, *given)
    assert f"Unit: {cell.unit}\n" in started.stdout
    assert run("systemctl", "show", cell.unit, "--value", "-p", "User").stdout == "alice\n"
    far, near = (json.loads(run(*words, "show", cell.name, "-o", "json").stdout) for words in (
        ("doractl", "-H", "root@base"), ("doractl",)
    ))  # fmt: skip
    assert far == near
    missing = doractl("list", "nothing", "--host=base")
    assert (missing.returncode, missing.stdout) == (ExitCode.NOT_FOUND, "")
    assert missing.stderr.startswith("doractl: no dataflow named 'nothing'\n")
    assert run("doractl", "stop", "-H", "base", cell.name).stdout.startswith("Dataflow stopped: ")
    assert cell.is_gone
    relative = doractl("-H", "base", "start", "nothing.yml")
    assert relative.returncode == ExitCode.BAD_INPUT
    assert "hint: FILE is a path on base" in relative.stderr


@pytest.mark.usefixtures("servers")
def test_several_hosts(cell: Cell, project: Project) -> None:
    """A table with the host; a host that is dead is a row, a line and an exit status."""
    cell.start(project.three_nodes())
    done = doractl("-H", "base,arm,gone", "list")
    header, first, second = (line.split() for line in done.stdout.splitlines())
    assert header[:4] == ["HOST", "UUID", "NAME", "STATUS"]
    assert (first[0], *first[2:4]) == ("base", cell.name, "Running")
    assert second[:4] == ["gone", "-", "-", "Unreachable"]
    (problem, hint) = done.stderr.splitlines()
    assert problem.startswith("doractl: cannot reach gone: connect to host 127.0.0.9 port 22: ")
    assert hint.startswith("hint: ")
    assert done.returncode == ExitCode.NO_HOST
    objects = json.loads(run("doractl", "list", "-H", "base,arm", "-o", "json").stdout)
    assert [(one["host"], one["name"]) for one in objects] == [("base", cell.name)]
    broken = doractl("list", "-H", "gone,base", "-o", "json")
    assert [one["name"] for one in json.loads(broken.stdout)] == [cell.name]
    (error,) = map(json.loads, broken.stderr.splitlines())
    assert (error["host"], error["error"]["exit_status"]) == ("gone", ExitCode.NO_HOST)
    stopped = doractl("stop", cell.name, "-H", "base,arm")
    assert stopped.returncode == ExitCode.NOT_FOUND
    assert stopped.stdout.startswith("base: Dataflow stopped: ")
    assert f"doractl: arm: no dataflow named '{cell.name}'" in stopped.stderr


@pytest.mark.usefixtures("servers")
def test_all_hosts() -> None:
    hosts = Path("/etc/dora-systemd/hosts")
    none = doractl("-H", "all", "version")
    assert none.returncode == ExitCode.BAD_INPUT
    assert str(hosts) in none.stderr
    hosts.parent.mkdir(exist_ok=True)
    hosts.write_text("# the robot\nbase\narm  # its arm\n")
    try:
        text = run("doractl", "-H", "all", "version").stdout
        found = json.loads(run("doractl", "-H", "all", "version", "-o", "json").stdout)
    finally:
        hosts.unlink()
    assert re.findall("==> (.*) <==", text) == ["base", "arm"]
    assert [one["host"] for one in found] == ["base", "arm"]
    assert found[0]["doractl"] == found[1]["doractl"]


@pytest.fixture
def hers(cell: Cell) -> Iterator[Cell]:
    """A dataflow of the same name, which is alice's."""
    yield Cell(cell.name, Scope(is_user=True, uid=1000))
    doractl("-H", "arm", "stop", cell.name)


@pytest.mark.usefixtures("servers")
def test_logs_of_several_hosts(cell: Cell, hers: Cell, project: Project) -> None:
    """One stream in the order of time; it ends with the command, here and there."""
    flow = str(project.three_nodes())
    run("doractl", "-H", "base", "start", flow, "--name", cell.name)
    run("doractl", "-H", "arm", "start", flow, "--name", hers.name)
    command = ["doractl", "logs", cell.name, "--node", "sink", "-H", "base,arm,gone"]
    sync_journal()
    with subprocess.Popen([*command, "-f"], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        lines: list[str] = []
        while {line.split()[0] for line in lines} != {"base", "arm"} or len(lines) < 100:
            lines.append(child.stdout.readline())
            assert lines[-1], "it has ended"
        # Others are of dora, such as "Discarding event" on a busy machine.
        assert all("sink" in line for line in lines)
        assert any(" got " in line for line in lines)
        child.send_signal(signal.SIGINT)
        child.stdout.read()
        assert child.wait(bound(20)) == ExitCode.INTERRUPTED
    wait_for("nothing follows over there", lambda: not sessions())
    run("doractl", "-H", "base,arm", "stop", cell.name)
    sync_journal()
    done = doractl(*command[1:], "-o", "json")
    assert done.returncode == ExitCode.NO_HOST
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert {record["host"] for record in records} == {"base", "arm"}
    times = [int(record["__REALTIME_TIMESTAMP"]) for record in records]
    assert times == sorted(times)
    matches = (f"DORA_DATAFLOW_NAME={cell.name}", "DORA_NODE=sink")
    assert len(records) == len(journalctl("-o", "cat", *matches).splitlines())


@pytest.mark.usefixtures("servers")
def test_the_terminal_of_a_host(cell: Cell, project: Project) -> None:
    """Colours, width, keys and Ctrl+C are those of a terminal there."""
    flow = project.three_nodes()
    cell.start(flow)
    assert "\x1b[4mUUID" in shown("doractl", "-H", "base", "list")
    with Tmux(60, 20) as tmux:
        tmux.press("doractl -H base list; echo status $?", "Enter")
        lines = tmux.wait("status 0")
        assert any(line.startswith("UUID ") and not line.endswith("BOOT") for line in lines)
        tmux.press("clear; doractl -H base top; echo top $?", "Enter")
        tmux.wait("sink")
        tmux.press("q")
        tmux.wait("top 0")
    cell.doractl("stop", cell.name)
    screen = Screen(["doractl", "-H", "base", "run", str(flow), "--name", cell.name])
    cell.wait_exchanging()
    screen.press(b"\x03")
    assert screen.end() == 0
    assert cell.is_gone


@pytest.mark.usefixtures("servers")
def test_run_ends_with_the_command(cell: Cell, project: Project) -> None:
    """Without a terminal, too, and however it ends."""
    command = ["doractl", "-H", "base", "run", str(project.three_nodes()), "--name", cell.name]
    for number, status in ((signal.SIGINT, 0), (signal.SIGKILL, -signal.SIGKILL)):
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
        cell.wait_exchanging()
        child.send_signal(number)
        child.communicate(timeout=bound(30))
        assert child.returncode == status
        wait_for("the dataflow has ended", lambda: cell.is_gone)


@pytest.mark.parametrize("shell", ["/bin/bash", "/usr/bin/fish", "/usr/bin/zsh", "/bin/dash"])
@pytest.mark.usefixtures("servers")
def test_login_shells(shell: str) -> None:
    """Whatever the shell prints before, and however it quotes."""
    noise = "echo hello; echo warning >&2\n"
    files = {".bashrc": noise, ".zshenv": noise, ".config/fish/config.fish": noise}
    with shell_of("alice", shell, files):
        assert json.loads(run("doractl", "-H", "arm", "list", "-o", "json").stdout) == []
        done = doractl("-H", "arm", "list", HOSTILE)
        assert done.returncode == ExitCode.NOT_FOUND
        assert done.stderr.startswith(f"doractl: no dataflow named {HOSTILE!r}\n")
        both = run("doractl", "-H", "arm,base", "list", "-o", "json")
        assert (json.loads(both.stdout), both.stderr) == ([], "")
    assert not Path("/tmp/remote-was-here").exists()


def test_hosts_that_do_not_work(servers: Servers) -> None:
    """One line and a hint for each, with the name of the host; nothing hangs."""
    servers.serve("127.0.0.4", more="")
    servers.name("bare", "127.0.0.4")
    servers.name("forged", HERE, key="other")
    servers.name("unknown", HERE, key="")
    servers.name("locked", HERE, "bob")
    servers.name("silent", "127.0.0.5")
    silent = socket.create_server(("127.0.0.5", 22))
    cases = {
        "bare": "cannot find doractl on bare",
        "forged": "cannot reach forged: the host key has changed",
        "unknown": "cannot reach unknown: Host key verification failed.",
        "nowhere.invalid": "cannot reach nowhere.invalid: Could not resolve hostname",
        "gone": "cannot reach gone: connect to host 127.0.0.9 port 22: Connection refused",
        "silent": "cannot reach silent: Connection timed out during banner exchange",
        "locked": "cannot run doractl on locked: This account is currently not available.",
    }
    with silent, shell_of("bob", "/usr/sbin/nologin", {}):
        begun = time.monotonic()
        several = doractl("-H", ",".join(cases), "version")
        assert time.monotonic() - begun < bound(15)
        lines = several.stderr.splitlines()
        for host, words in cases.items():
            assert sum(line.startswith(f"doractl: {words}") for line in lines) == 1, lines
            if host != "silent":
                single = doractl("-H", host, "stop", "--all")
                assert (single.returncode, single.stdout) == (ExitCode.NO_HOST, "")
                assert single.stderr.startswith(f"doractl: {words}")
                assert len(single.stderr.splitlines()) == 2
    assert len(lines) == 2 * len(cases)
    assert (several.returncode, several.stdout) == (ExitCode.NO_HOST, "")


@pytest.mark.usefixtures("servers")
def test_a_connection_that_is_cut(cell: Cell, project: Project) -> None:
    """It is one line, and the dataflow goes on."""
    cell.start(project.three_nodes())
    command = ["doractl", "-H", "base", "logs", cell.name, "-f"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout and child.stderr
        child.stdout.readline()
        for session in run("pgrep", "-f", "sshd-session: root@notty").stdout.split():
            with suppress(ProcessLookupError):  # one of an earlier command may end just now
                os.kill(int(session), signal.SIGKILL)
        child.stdout.read()
        assert child.wait(bound(20)) == ExitCode.NO_HOST
        assert child.stderr.read().startswith(b"doractl: the connection to base is lost")
    cell.wait_exchanging()


@pytest.mark.usefixtures("servers")
def test_a_host_that_dies_in_the_middle(cell: Cell, hers: Cell, project: Project) -> None:
    """It is lost within its bound, and the lines of the others go on."""
    flow = str(project.three_nodes())
    run("doractl", "-H", "base", "start", flow, "--name", cell.name)
    run("doractl", "-H", "arm", "start", flow, "--name", hers.name)
    command = ["doractl", "logs", cell.name, "--node", "sink", "-H", "base,arm", "-f"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as child:
        assert child.stdout and child.stderr
        while not child.stdout.readline().startswith("arm "):
            pass
        # As if its cable were pulled: nothing answers any more.
        stopped = [int(one) for one in run("pgrep", "-f", "sshd-session: alice").stdout.split()]
        for session in stopped:
            os.kill(session, signal.SIGSTOP)
        begun = time.monotonic()
        try:
            said = child.stderr.readline()
            assert 10 < time.monotonic() - begun < bound(25)
            assert said.startswith("doractl: the connection to arm is lost")
            while not child.stdout.readline().startswith("base "):
                pass
        finally:
            for session in stopped:
                os.kill(session, signal.SIGCONT)
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=bound(20))
        assert child.returncode == ExitCode.INTERRUPTED
    wait_for("nothing follows over there", lambda: not sessions())


@pytest.mark.usefixtures("servers")
def test_doctor_of_several_hosts() -> None:
    """The findings of each with its host; one that is dead is a line."""
    done = doractl("-H", "base,gone,arm", "doctor", "-o", "json")
    found = json.loads(done.stdout)
    assert {one["host"] for one in found} == {"base", "arm"}
    assert done.returncode == ExitCode.NO_HOST
    assert "cannot reach gone" in json.loads(done.stderr.splitlines()[0])["error"]["message"]
    text = doractl("-H", "base,arm", "doctor").stdout
    assert re.findall("==> (.*) <==", text) == ["base", "arm"]

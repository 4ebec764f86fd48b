"""The gateway: doractl up, who may ask, and that nothing depends on it."""

import os
import signal
import socket
import time

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from dora_systemd.decisions.gateway.place import SERVICE_UNIT, SOCKET_UNIT
from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.gatewayfuzz import attack
from tests.system.gatewayload import ask_steadily, half_open, read_use
from tests.system.gateways import Front

# Speaks as several users, and opens the port.
pytestmark = pytest.mark.lab

UP = """\
Starting dora daemon...
  ✓ Coordinator started on port {port}
  ✓ Daemon ready

Daemon running at: http://localhost:{port}
"""
USE = """
Use 'eval "$(doractl env)"' to connect the dora command to it
"""
UP += USE
AGAIN = "Daemon already running at: http://localhost:{port}\n" + USE


def test_up(front: Front) -> None:
    assert front.doractl("up").stdout == UP.format(port=53290)
    pid, token = front.pid, front.token
    again = front.doractl("up")
    assert again.stdout == AGAIN.format(port=53290)
    assert (front.pid, front.token) == (pid, token)
    # To another port, and back.
    front.port = 53292
    assert front.up() == UP.format(port=53292)
    assert front.get("/health") == (200, "ok")
    assert front.token != token
    assert front.doractl("up").stdout == AGAIN.format(port=53292)
    environment = {**os.environ, "DORA_COORDINATOR_ADDR": "localhost:53290"}
    assert run("doractl", "up", env=environment).stdout == UP.format(port=53290)
    assert "process" not in front.journal()


def test_units_in_use_are_good(front: Front) -> None:
    front.up()
    paths = [front.show("FragmentPath", unit) for unit in (SOCKET_UNIT, SERVICE_UNIT)]
    assert run("systemd-analyze", "verify", "--man=no", *paths).stderr == ""
    assert front.show("ControlGroup") == f"/dora.slice/{SERVICE_UNIT}"


def test_who_may(front: Front, alice: Front) -> None:
    front.up()
    alice.up()
    for one, others in ((front, ("alice", "bob")), (alice, ("bob",))):
        for user in ("", one.user):
            assert one.get("/nothing", user=user).status == 404
        for user in others:
            assert one.get("/health", user=user) == (200, "ok")
            assert one.get("/nothing", user=user).status == 401
            wrong = f"Authorization: Bearer {one.token[::-1]}"
            assert one.get("/nothing", "-H", wrong, user=user).status == 401
            right = f"Authorization: Bearer {one.token}"
            assert one.get("/nothing", "-H", right, user=user).status == 404
    secret = front.scope.runtime_root / "dora-systemd-gateway/token"
    assert run("runuser", "-u", "alice", "cat", str(secret), check=False).stdout == ""


def test_other_sites_are_kept_out(front: Front) -> None:
    front.up()
    for header in (
        "Host: evil.example",
        "Host: evil.example:53290",
        "Host:",
        "Origin: http://evil.example",
        "Origin: null",
        "Origin: http://localhost:53290",
    ):
        assert front.get("/health", "-H", header).status == 403, header
    assert front.get("/health", "-H", "Origin: http://127.0.0.1:53290").status == 200


def test_other_methods(front: Front) -> None:
    front.up()
    # Not all versions of websockets read the method.
    assert front.get("/health", "-X", "DELETE").status in (400, 405)
    assert front.get("/health", "-d", "x").status in (400, 405)
    assert front.get("/health", "--head").status in (400, 405)
    assert front.get("/health", "--http1.0").status == 400
    twice = ("-H", "Upgrade: x", "-H", "Upgrade: y")
    assert front.get("/health", *twice).status == 200
    assert front.get("/health").status == 200


def test_a_port_in_use(front: Front, alice: Front) -> None:
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(("127.0.0.1", 53290))
        one.listen()
        for who, words in ((front, f"process {os.getpid()} ("), (alice, "a process of root")):
            done = who.doractl("up", check=False)
            assert done.returncode == ExitCode.NAME_IN_USE
            first, second = done.stderr.splitlines()
            assert first.startswith("doractl: cannot open port 53290: it is in use by ")
            assert words in first
            for way in ("stop that process", "doractl up --port 53291", "doractl start"):
                assert way in second
    assert front.systemctl("list-units", "--all", "--plain", "--no-legend", "dora-g*") == ""


@pytest.mark.parametrize(
    "variable", ["DORA_COORDINATOR_ADDR=192.168.1.5", "DORA_DAEMON_PORT=nonsense"]
)
def test_wrong_variables(variable: str, front: Front) -> None:
    done = run("env", variable, "doractl", "up", check=False)
    assert (done.returncode, done.stdout) == (ExitCode.USAGE, "")
    assert variable.partition("=")[0] in done.stderr
    assert not front.pid


@pytest.mark.warns("dora-gateway.service: Main process exited", "Failed with result 'signal'")
def test_killed_again_and_again(front: Front, cell: Cell, project: Project) -> None:
    """Dataflows do not notice, and the next connection finds a new one."""
    cell.start(project.three_nodes())
    front.up()
    token, before = front.token, cell.all_pids()
    for _ in range(15):
        pid = wait_for("a gateway", lambda: front.get("/health").status == 200 and front.pid)
        os.kill(pid, signal.SIGKILL)
        wait_for("its end", lambda pid=pid: front.pid != pid)  # type: ignore[misc]
    assert front.get("/health") == (200, "ok")
    assert front.token == token
    assert front.show("ActiveState", SOCKET_UNIT) == "active"
    assert cell.all_pids() == before
    cell.wait_exchanging()


def test_it_rests_and_comes_back(front: Front) -> None:
    front.up()
    front.rest_after("1s")
    assert front.get("/health").status == 200
    front.wait_resting()
    assert front.show("Result") == "success"
    assert front.show("ActiveState", SOCKET_UNIT) == "active"
    assert run("systemctl", "show", "-P", "MemoryCurrent", SERVICE_UNIT).stdout in (
        "[not set]\n",
        "0\n",
    )
    assert front.get("/health").status == 200
    # What is open keeps it.
    with connect(f"ws://127.0.0.1:{front.port}/api/live") as page:
        pid = front.pid
        page.recv()
        wait_for("time passes", lambda: page.recv() and _age(pid) > 4)
        assert front.pid == pid
    front.wait_resting()


def test_a_page_of_another_origin(front: Front) -> None:
    """WebSockets are not covered by what browsers call the same origin policy."""
    front.up()
    for path in ("/api/live", "/api/control"):
        url = f"ws://localhost:{front.port}{path}"
        with pytest.raises(InvalidStatus) as caught:
            connect(url, origin=Origin("http://evil.example"))
        assert caught.value.response.status_code == 403
        with connect(url, origin=Origin(f"http://localhost:{front.port}")):
            pass


def _age(pid: int) -> float:
    return float(run("ps", "-o", "etimes=", "-p", str(pid)).stdout)


def test_a_hundred_requests_a_second(front: Front) -> None:
    """A short version; gatewayload runs for as long as one likes."""
    front.up()
    paths = ("/health", "/nothing", "/metrics", "/")
    ask_steadily(front.port, paths, 4)  # threads are made, modules loaded
    pid = front.pid
    growth: list[int] = []
    # A thread more takes memory once, and a leak again and again.
    while not growth or (growth[-1] >= 1024 * 1024 and len(growth) < 4):
        before = read_use(pid)
        answers = ask_steadily(front.port, paths, 8).answers
        assert {*answers} == {"/health 200", "/nothing 404", "/metrics 200", "/ 200"}
        wait_for("connections end", lambda: read_use(pid).descriptors <= before.descriptors)  # noqa: B023
        growth.append(read_use(pid).memory - before.memory)
    assert front.pid == pid
    assert growth[-1] < 1024 * 1024, growth
    assert read_use(pid).threads <= (os.cpu_count() or 1) + 5  # as many as asyncio has, and one
    assert "Traceback" not in front.journal()


def test_nonsense(front: Front) -> None:
    front.up()
    attack(front.port, 0, 300)  # the largest frames set what is kept
    pid, before = front.pid, read_use(front.pid)
    answers = attack(front.port, 1, 300)
    assert answers["http 403"]
    assert answers["http closed"]
    assert not [one for one in answers if one.endswith(("500", "503", "504"))]
    assert front.pid == pid
    assert front.get("/health") == (200, "ok")
    wait_for("connections end", lambda: read_use(pid).descriptors <= before.descriptors)
    assert read_use(pid).memory - before.memory < 4 * 1024 * 1024
    said = front.journal().splitlines()
    assert not [line for line in said if "Traceback" in line or line.startswith("cannot ")]


def test_many_who_say_nothing(front: Front) -> None:
    """More connections than there may be: the gateway goes on, and is there when they have gone."""
    front.up()
    pid = front.pid
    many = [socket.create_connection(("127.0.0.1", front.port)) for _ in range(400)]
    wait_for("too many", lambda: read_use(pid).descriptors > 200)
    for one in many:
        one.close()
    wait_for("an answer", lambda: front.get("/health").status == 200)
    wait_for("connections end", lambda: read_use(pid).descriptors < 30)
    assert front.pid == pid
    assert "Traceback" not in front.journal()


def test_a_stranger_cannot_shut_the_others_out(front: Front) -> None:
    """He holds 400 requests half open; root is answered at once, and he is let go of soon."""
    front.up()
    assert front.get("/health").status == 200
    with half_open(front.port, "alice", 400, 20):
        begin = time.monotonic()
        answers = [front.get("/metrics").status for _ in range(5)]
        took = time.monotonic() - begin
        assert answers == [200] * 5
        assert took < bound(5)
        open_ones = f"state established sport = :{front.port}".split()
        count = len(run("ss", "-Htn", *open_ones).stdout.splitlines())
        assert count <= 16
        wait_for("they are let go of", lambda: not run("ss", "-Htn", *open_ones).stdout, 5)
        token = f"Authorization: Bearer {front.token}"
        assert front.get("/metrics", "-H", token, user="alice").status == 200

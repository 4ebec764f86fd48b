"""The stock dora command, pointed at the gateway, with dataflows of two users."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.gateways import Front

# Speaks as several users, and opens the port.
pytestmark = [pytest.mark.lab, pytest.mark.usefixtures("gateway_up")]

CRASHER = """
import sys, time
from dora import Node
node = Node()
print("no use", file=sys.stderr, flush=True)
sys.exit(3)
"""
FINISHER = """
from dora import Node
node = Node()
print("done", flush=True)
"""
HANGER = """
import signal, time
from dora import Node
signal.signal(signal.SIGTERM, signal.SIG_IGN)
node = Node()
print("hanging", flush=True)
while True:
    time.sleep(1)
"""
TALKER = """
from dora import Node
node = Node()
for n in range(30_000):
    print(n, "x" * 60)
print("all said", flush=True)
for event in node:
    pass
"""
NO_SUCH_UUID = "00000000-0000-4000-8000-000000000000"


class Dora:
    """The dora command, as root or as another user."""

    def __init__(self, front: Front) -> None:
        self.environment = {
            **os.environ,
            "DORA_COORDINATOR_ADDR": "127.0.0.1",
            "DORA_COORDINATOR_PORT": str(front.port),
        }

    def __call__(
        self, *words: str, check: bool = True, **more: str
    ) -> subprocess.CompletedProcess[str]:
        return run("dora", *words, check=check, env={**self.environment, **more})

    def json_lines(self, *words: str) -> list[dict[str, Any]]:
        """The output of a listing."""
        out = self(*words, "--format", "json").stdout
        return [json.loads(line) for line in out.splitlines()]

    def refusal(self, *words: str) -> str:
        """What a command says that fails."""
        done = self(*words, check=False)
        assert done.returncode == 1, done
        return done.stderr

    @contextmanager
    def running(self, *words: str) -> Iterator["subprocess.Popen[str]"]:
        """A command in the background; Ctrl+C reaches it."""
        with subprocess.Popen(
            ["dora", *words],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            restore_signals=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as child:
            try:
                yield child
            finally:
                child.kill()


def read_until(child: "subprocess.Popen[str]", words: str) -> list[str]:
    """The lines up to the first one that has `words` in it."""
    lines: list[str] = []
    assert child.stdout
    for line in child.stdout:
        lines.append(line.rstrip("\n"))
        if words in line:
            return lines
    raise AssertionError(f"not said: {words}\n" + "\n".join(lines))


@pytest.fixture
def dora(front: Front) -> Dora:
    return Dora(front)


@contextmanager
def new_places() -> Iterator[Sequence[Project]]:
    """Directories of alice, of bob, and of alice again."""
    root = Path(tempfile.mkdtemp(prefix="flows-", dir="/var/tmp"))
    root.chmod(0o755)
    owners = ("alice", "bob", "alice")
    projects = [Project(root / f"place{number}") for number in range(len(owners))]
    for project, owner in zip(projects, owners, strict=True):
        flow = project.three_nodes()
        # Root's gateway has neither the PATH nor the environment of whoever calls dora start.
        project.write(f"{flow.stem}.systemd.yml", f"venv: {sys.prefix}\n")
        run("chown", "-R", owner, str(project.root))
    yield projects
    shutil.rmtree(root)


@contextmanager
def started(dora: Dora, places: Sequence[Project]) -> Iterator[list[Cell]]:
    """Three dataflows of two users."""
    cells = [Cell(name) for name in ("one", "two", "three")]
    flows = [str(place.root / "dataflow.yml") for place in places]
    options = [("--name", one.name, "--detach", "--debug") for one in cells]
    try:
        with ThreadPoolExecutor() as pool:
            list(pool.map(lambda flow, words: dora("start", flow, *words), flows, options))
        yield cells
    finally:
        for one in cells:
            one.end()


@pytest.fixture
def places() -> Iterator[Sequence[Project]]:
    with new_places() as places:
        yield places


@pytest.fixture
def three(dora: Dora, cell: Cell, places: Sequence[Project]) -> Iterator[list[Cell]]:
    """Three dataflows; `cell` holds the rules about what may be left of them."""
    del cell
    with started(dora, places) as cells:
        yield cells


@pytest.fixture(scope="class")
def same_three(class_cell: Cell) -> Iterator[list[Cell]]:
    """The same for tests that stop none of them."""
    del class_cell
    front = Front()
    front.up()
    with new_places() as places, started(Dora(front), places) as cells:
        front.end()
        yield cells


def uuids(dora: Dora) -> dict[str, str]:
    return {one["name"]: one["uuid"] for one in dora.json_lines("list", "--status", "running")}


# What dora's own coordinator says when it publishes for the first time.
@pytest.mark.warns("multicast interface", "Cannot join IpV4 multicast group")
def test_topics_and_parameters(dora: Dora, three: list[Cell]) -> None:
    said = dora("topic", "echo", "-d", "two", "source/number", "--count", "3", "--format", "json")
    values = [json.loads(line)["data"][0] for line in said.stdout.splitlines()]
    assert values == sorted({*values}), "dora may leave some out on its way to the coordinator"
    assert len(values) == 3
    assert "source/number" in dora("topic", "hz", "-d", "one", "--duration", "1").stdout
    assert (
        "doubler/number"
        in dora("topic", "info", "-d", "one", "source/number", "--duration", "1").stdout
    )
    assert "doubler/number" in dora("topic", "list", "-d", "three").stdout
    before = len(three[2].messages("doubler"))
    dora("topic", "pub", "-d", "three", "source/number", "[77]")
    assert before == 0
    assert "Set `rate` = 5" in dora("param", "set", "-d", "two", "source", "rate", "5").stdout
    assert dora("param", "get", "-d", "two", "source", "rate").stdout.strip() == "5"
    assert "rate = 5" in dora("param", "list", "-d", "two", "source").stdout
    assert "No parameters" in dora("param", "list", "-d", "one", "source").stdout
    dora("param", "delete", "-d", "two", "source", "rate")
    assert "No parameters" in dora("param", "list", "-d", "two", "source").stdout
    # The end of a dataflow ends what listens to it.
    with dora.running("topic", "echo", "-d", "three", "source/number") as echo:
        read_until(echo, "source/number")
        dora("stop", "three")
        wait_for("its end", lambda: echo.poll() is not None)


@pytest.mark.warns("node exited with error: Signal(15)", "failed to receive reply from daemon")
def test_single_nodes(dora: Dora, three: list[Cell]) -> None:
    before = [cell.status.nodes for cell in three]
    dora("node", "restart", "source", "-d", "two")
    old = before[1]["source"].pid
    wait_for("another source", lambda: three[1].status.nodes["source"].pid not in (0, old))
    wait_for("it runs", lambda: three[1].status.nodes["source"].state == "running")
    three[1].wait_exchanging()
    assert three[1].status.nodes["sink"].pid == before[1]["sink"].pid
    dora("node", "stop", "sink", "-d", "two", "--grace", "2s")
    wait_for("it is gone", lambda: not three[1].status.nodes["sink"].is_alive)
    assert "(dora node stop)" in three[1].status.nodes["sink"].asked_by
    assert three[1].status.nodes["source"].restarts == 0
    assert [three[n].status.nodes for n in (0, 2)] == [before[0], before[2]]


@pytest.mark.warns("on shutdown")
def test_stop_and_restart(dora: Dora, three: list[Cell]) -> None:
    known = uuids(dora)
    run_before = three[0].status.run
    restarted = dora("restart", "one").stdout
    assert restarted == f"dataflow restarted: {known['one']} -> {known['one']}\n"
    assert three[0].status.run not in ("", run_before)
    pid = three[2].supervisor_pid("runner")
    dora("restart", known["three"], "--grace-duration", "5s")
    assert three[2].supervisor_pid("runner") != pid
    dora("stop", known["two"])
    assert three[1].is_gone
    assert (
        "Stop of dataflow two requested by root (dora stop)" in run("doractl", "why", "two").stdout
    )
    assert three[0].show("ActiveState") == three[2].show("ActiveState") == "active"
    dora("stop", "--all")
    assert all(cell.is_gone for cell in three)
    listed = {one["uuid"]: one["status"] for one in dora.json_lines("list")}
    assert {uuid: listed[uuid] for uuid in known.values()} == dict.fromkeys(
        known.values(), "Finished"
    )


def test_logs(dora: Dora, three: list[Cell]) -> None:
    known = uuids(dora)
    # Not those of an earlier dataflow of that name.
    words = ("logs", three[1].status.uuid, "--node", "source")
    wait_for("lines", lambda: dora(*words).stdout.count("\n") > 20)
    lines = dora("logs", "two", "--node", "source").stdout.splitlines()
    assert [line.split(" ", 2)[2] for line in lines[:3]] == [f"source: sent {n}" for n in range(3)]
    assert len(dora("logs", "two", "--tail", "5").stdout.splitlines()) == 5
    with dora.running("logs", "two", "--follow", "--node", "source") as follow:
        seen = read_until(follow, "sent 60")
        # Neither a gap nor a double between what was there and what comes.
        numbers = [int(line.rpartition(" ")[2]) for line in seen if "sent" in line]
        assert numbers == list(range(61))
        dora("stop", known["two"])
        assert follow.wait(30) == 0
    # It has ended, and the journal has its lines.
    ended = dora("logs", known["two"]).stdout
    assert "source: sent 60" in ended
    assert "sink: got" in ended
    assert "sent 5" in dora("logs", known["two"], "--node", "source", "--grep", "sent 5").stdout


def test_logs_have_no_cliff(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    place = places[0]
    place.write("talker.py", TALKER)
    flow = place.write("talker.yml", "nodes: [{id: talker, path: talker.py}]\n")
    place.write("talker.systemd.yml", (place.root / "dataflow.systemd.yml").read_text())
    dora("start", str(flow), "--name", cell.name, "--detach")
    wait_for("all is said", lambda: cell.journal("DORA_NODE=talker", "MESSAGE=all said"))
    lines = dora("logs", cell.name, "--node", "talker").stdout.splitlines()
    said = [line.partition("talker: ")[2] for line in lines]
    assert said[-1] == "all said"
    assert [int(line.split()[0]) for line in said[:-1]] == list(range(30_000))
    assert dora("logs", cell.name, "--tail", "1").stdout.endswith("all said\n")


def test_attached(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    flow = str(places[1].root / "dataflow.yml")
    with dora.running("start", flow, "--name", cell.name, "--attach") as attached:
        seen = read_until(attached, "got [")
        assert any("dora-systemd Node source is ready" in line for line in seen)
        assert cell.show("User") == "bob"
        attached.send_signal(signal.SIGINT)
        assert attached.wait(bound(30)) == 0
    assert cell.is_gone


def hanging(place: Project) -> str:
    """A dataflow that does not end by itself, nor within the 15 s that it is given."""
    place.write("hanger.py", HANGER)
    place.write("hanger.systemd.yml", (place.root / "dataflow.systemd.yml").read_text())
    return str(place.write("hanger.yml", "nodes: [{id: only, path: hanger.py}]\n"))


@pytest.mark.warns("was killed due to not stopping", "killed on drop", "error: Signal(9)")
def test_attached_and_impatient(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    """At the second Ctrl+C the command goes, without a word to anybody; the stop goes on."""
    flow = hanging(places[0])
    settings = places[0].root / "hanger.systemd.yml"
    settings.write_text(settings.read_text() + "grace_duration: 2s\n")
    with dora.running("start", flow, "--name", cell.name, "--attach") as attached:
        read_until(attached, "all nodes are ready")
        attached.send_signal(signal.SIGINT)
        wait_for("it stops", lambda: cell.show("ActiveState") == "deactivating")
        attached.send_signal(signal.SIGINT)
        assert attached.wait(bound(5)) == 1
    wait_for("it is gone", lambda: cell.is_gone)


@pytest.mark.warns("Killing process", "Main process exited", "Failed with", "was killed (SIGKILL)")
def test_by_force(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    flow = hanging(places[0])
    for words in (("--force",), ("--grace-duration", "1s")):
        dora("start", flow, "--name", cell.name, "--detach")
        began = time.monotonic()
        dora("restart", cell.name, *words)
        done = dora("stop", cell.name, *words, check=False)
        assert time.monotonic() - began < bound(14)
        assert cell.is_gone
        # As with dora itself, one whose patience was at an end is told so.
        assert done.returncode == ("--force" not in words), done


@pytest.mark.usefixtures("cell")
def test_settings_are_those_of_the_file(dora: Dora, places: Sequence[Project]) -> None:
    place = places[0]
    settings = place.root / "dataflow.systemd.yml"
    settings.write_text(settings.read_text() + "grace_duration: 7s\nenv: {ONE: file, TWO: file}\n")
    started = dora("start", str(place.root / "dataflow.yml"), "--detach", "--env", "ONE=flag")
    # Without --name it is called as its directory, as by doractl start.
    try:
        other = Cell("place0")
        uuid = started.stdout.rpartition("dataflow started: ")[2].split()[0]
        assert other.status.uuid == uuid
        assert "--grace-duration=7s" in other.show("ExecStart")
        assert {"ONE=flag", "TWO=file"} <= set(other.show("Environment").split())
        assert "cannot start place0" in dora.refusal("start", str(place.root / "dataflow.yml"))
    finally:
        Cell("place0").end()


@pytest.mark.warns(
    *("node exited with error", "crashed", "failed", "Failed with result", "Failed to start")
)
def test_dataflows_that_end(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    place = places[0]
    early = "raise SystemExit('no camera')"
    for name, text in (("crasher", CRASHER), ("finisher", FINISHER), ("early", early)):
        place.write(f"{name}.py", text)
        place.write(f"{name}.yml", f"nodes: [{{id: only, path: {name}.py}}]\n")
        place.write(f"{name}.systemd.yml", (place.root / "dataflow.systemd.yml").read_text())
    done = dora("start", str(place.root / "finisher.yml"), "--name", cell.name, "--attach")
    assert "stdout only: done" in done.stdout
    flow = str(place.root / "crasher.yml")
    failed = dora("start", flow, "--name", cell.name, "--attach", check=False)
    assert failed.returncode == 1
    assert "Node `only` failed" in failed.stderr
    assert "no use" in failed.stderr
    assert dora("list", "--status", "failed", "--quiet").stdout
    error = dora.refusal("start", str(place.root / "early.yml"), "--name", cell.name, "--detach")
    assert f"cannot start {cell.name}: node only: exit code 1" in error
    assert "no camera" in error


def test_which_file_is_meant(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    """Start has no file name: twins are told apart by dora's session file, or not at all."""
    place = places[0]
    twin = place.write("twin.yml", (place.root / "dataflow.yml").read_text())
    place.write("twin.systemd.yml", (place.root / "dataflow.systemd.yml").read_text())
    dora("start", str(twin), "--name", cell.name, "--detach")
    assert str(twin) in cell.show("ExecStart")
    dora("stop", cell.name)
    hidden = place.root / "flow.txt"
    twin.rename(hidden)
    (place.root / "dataflow.yml").unlink()
    error = dora.refusal("start", str(hidden), "--detach")
    assert "cannot find out which file" in error
    assert "doractl start FILE" in error


def test_numbers_that_dora_cannot_send(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    place = places[0]
    shown = "import os\nfrom dora import Node\nNode()\nprint(os.environ['A'], os.environ['B'])\n"
    place.write("one.py", shown)
    text = "env: {A: inf, B: '${B}'}\nnodes: [{id: one, path: one.py}]\n"
    words = ("start", str(place.write("dataflow.yml", text)), "--name", cell.name, "--attach")
    assert "inf 5" in dora(*words, B="5").stdout
    refused = dora(*words, check=False, B="nan")
    assert refused.returncode == 1
    assert "env 'B' is infinite or not a number" in refused.stderr


def test_one_that_is_enabled(dora: Dora, cell: Cell, places: Sequence[Project]) -> None:
    """The unit file of one that was disabled while it ran is in the way of the next start."""
    flow = places[0].root / "dataflow.yml"
    uuid = json.loads(cell.start(flow, "--enable", "-o", "json").stdout)["uuid"]
    dora("stop", cell.name)
    dora("restart", cell.name)
    assert uuids(dora) == {cell.name: uuid}
    cell.doractl("disable", cell.name)
    dora("stop", uuid)
    dora("start", str(flow), "--name", cell.name, "--detach")
    assert uuids(dora)[cell.name] != uuid
    assert cell.show("FragmentPath").startswith("/run/systemd/transient/")


def test_nothing_stays_behind(
    dora: Dora, front: Front, cell: Cell, places: Sequence[Project]
) -> None:
    """Neither descriptors nor children of commands that went, nor units that it once held."""
    flow = str(places[0].root / "dataflow.yml")
    for _ in range(2):
        dora("start", flow, "--name", cell.name, "--detach", "--debug")
        dora("restart", cell.name)
        dora("stop", cell.name)
    dora("start", flow, "--name", cell.name, "--detach", "--debug")
    pid, count = front.pid, _descriptors(front.pid)
    for words, said in (
        (("logs", cell.name, "--follow"), "got"),
        (("topic", "echo", "-d", cell.name, "source/number"), "source/number"),
    ) * 3:
        with dora.running(*words) as child:
            read_until(child, said)
    for _ in range(5):
        dora("node", "list")
        dora("logs", cell.name, "--tail", "1")
    wait_for("no child", lambda: not run("pgrep", "-P", str(pid), check=False).stdout)
    wait_for("no descriptor", lambda: _descriptors(pid) <= count)
    assert front.pid == pid


def _descriptors(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


@pytest.mark.warns("dora-gateway.service: Main process exited", "Failed with result 'signal'")
@pytest.mark.warns("control request failed: node `sonk` not found", "on shutdown")
class TestSameThree:
    """None of them is stopped."""

    def test_killed_while_logs_are_followed(
        self, dora: Dora, front: Front, same_three: list[Cell]
    ) -> None:
        before = [cell.all_pids() for cell in same_three]
        with dora.running("logs", "two", "--follow") as follow:
            read_until(follow, "sent 5")
            os.kill(front.pid, signal.SIGKILL)
            follow.wait(30)
        assert [cell.all_pids() for cell in same_three] == before
        same_three[1].wait_exchanging()
        # The next command finds another gateway.
        assert sorted(uuids(dora)) == ["one", "three", "two"]

    def test_lists_and_nodes(self, dora: Dora, same_three: list[Cell]) -> None:
        listed = dora.json_lines("list", "--status", "running")
        found = {one["name"]: one for one in listed}
        assert sorted(found) == ["one", "three", "two"]
        for cell in same_three:
            assert found[cell.name]["uuid"] == cell.status.uuid
            assert found[cell.name]["nodes"] == 3
            assert found[cell.name]["memory"] > 0.05
        assert [cell.show("User") for cell in same_three] == ["alice", "bob", "alice"]
        nodes = dora.json_lines("node", "list", "-d", "two")
        assert {one["node"]: int(one["pid"]) for one in nodes} == {
            name: node.pid for name, node in same_three[1].status.nodes.items()
        }
        assert len(dora("node", "list", "--quiet").stdout.split()) == 9
        info = json.loads(dora("node", "info", "doubler", "-d", "two", "--format", "json").stdout)
        assert "doubler.py" in json.dumps(info)
        assert "launcher" not in json.dumps(info)
        top = json.loads(dora("top", "--once").stdout)
        assert len(top) == 9
        assert all(one["metrics"]["pid"] for one in top)
        status = dora("status").stdout
        assert "Active dataflows: 3" in status
        assert "✓ Daemon: Running" in status
        assert dora("doctor").returncode == 0

    def test_refusals(self, dora: Dora, same_three: list[Cell], places: Sequence[Project]) -> None:
        for words, expected in (
            (("stop", NO_SUCH_UUID), "no dataflow with the UUID"),
            (("stop", "tow"), "did you mean two?"),
            (("restart", "nobody"), "no dataflow named 'nobody'"),
            (("logs", NO_SUCH_UUID, "--node", "a"), "no dataflow with the UUID"),
            (("logs", "two", "--node", "sonk"), "did you mean sink?"),
            (("node", "restart", "sonk", "-d", "two"), "did you mean sink?"),
            (("node", "stop", "sonk", "-d", "two"), "did you mean sink?"),
            (("param", "get", "-d", "two", "sonk", "x"), "not found"),
            (("topic", "echo", "-d", "two", "sonk/x", "--count", "1"), "sonk"),
            (("clean",), "the journal"),
            (("trace", "list"), "doractl dora NAME"),
            (("down",), "refusing to destroy"),
        ):
            assert expected in dora.refusal(*words), words
        assert [cell.show("ActiveState") for cell in same_three] == ["active"] * 3
        node = places[0].write("node.yml", "{id: more, path: more.py}\n")
        error = dora.refusal("node", "add", "-d", "two", "--from-yaml", str(node))
        assert "cannot change a supervised dataflow" in error

    def test_who_may(self, dora: Dora, front: Front, same_three: list[Cell]) -> None:
        as_bob = ("runuser", "-u", "bob", "--", "env", "HOME=/home/bob", "dora")
        for words in (("list",), ("stop", "--all"), ("logs", "two")):
            done = run(*as_bob, *words, check=False, env=dora.environment)
            assert done.returncode == 1
            assert "401 Unauthorized" in done.stderr or "no out/ directory" in done.stderr, words
        with_token = {**dora.environment, "DORA_AUTH_TOKEN": front.token}
        assert "two" in run(*as_bob, "list", env=with_token).stdout
        assert [cell.show("ActiveState") for cell in same_three] == ["active"] * 3

    def test_a_restart_that_is_inhibited(self, dora: Dora, same_three: list[Cell]) -> None:
        two = same_three[1]
        before = two.show("InvocationID")
        with (two.scope.cell_directory("two") / "inhibit.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH)
            assert "cannot restart two: inhibited by" in dora.refusal("restart", "two")
        assert two.show("InvocationID") == before
        dora("restart", "two")
        assert two.show("InvocationID") != before

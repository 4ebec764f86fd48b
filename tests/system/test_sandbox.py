"""The sandbox on a real system: its score, what nodes can still do, and what they cannot."""

import grp
import json
import os
import pwd
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.place import SERVICE_UNIT
from dora_systemd.decisions.properties.sandbox import NETWORKS
from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.where import DEFAULT_USER
from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.gateways import Front
from tests.system.refusals import Refusal, check_refusals

pytestmark = pytest.mark.lab

LEVELS = ("none", "default", "strict")
HIGHEST = 2.0
"""What `systemd-analyze security` may say of a unit that nobody has configured."""
HIGHEST_OF_THE_GATEWAY = 3.0
"""It starts units, so it is as good as root in any case."""

PROBE = """
import errno, json, os, socket
from dora import Node

def write(path):
    with open(path, "w") as file:
        file.write("x")

def send(address):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"x", (address, 9))

def read(path):
    open(path, "rb").close()

def tried(text):
    verb, _, what = text.partition(":")
    try:
        globals()[verb](what)
    except OSError as error:
        return errno.errorcode[error.errno]
    return "ok"

node = Node()
print("tried", json.dumps({one: tried(one) for one in os.environ["PROBE"].split()}), flush=True)
for event in node:
    pass
"""
FLOW = "nodes: [{id: probe, path: probe.py, inputs: {t: dora/timer/millis/100}}]\n"


def tried(cell: Cell) -> list[str]:
    """What the node has printed; zenoh prints more on a slow machine."""
    return [one for one in cell.messages("probe") if one.startswith("tried ")]


def probe(cell: Cell, project: Project, *flags: str, tries: list[str]) -> list[str]:
    """What comes of each try of a node."""
    project.write("probe.py", PROBE)
    flow = project.write("dataflow.yml", FLOW)
    before = len(tried(cell))
    cell.start(flow, "--env", f"PROBE={' '.join(tries)}", *flags)
    (line,) = wait_for("the node tries", lambda: tried(cell)[before:])
    found = json.loads(line.partition(" ")[2])
    return [found[one] for one in tries]


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory outside of the project that everyone may write."""
    path = Path("/srv/recordings")
    path.mkdir()
    path.chmod(0o777)
    yield path
    shutil.rmtree(path)


def exposure(unit: str) -> float:
    """The score of a unit of the system, as systemd-analyze prints it."""
    words = ("systemd-analyze", "security", "--no-pager", unit)
    last = run(*words).stdout.splitlines()[-1]
    return float(last.partition(": ")[2].split()[0])


def test_exposure_with_a_device_and_in_a_home(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--device", "/dev/null")
    assert exposure(cell.unit) <= HIGHEST


def test_exposure_of_the_gateway(front: Front, capsys: pytest.CaptureFixture[str]) -> None:
    front.up()
    front.get("/metrics")
    found = exposure(SERVICE_UNIT)
    with capsys.disabled():
        print(f" exposure of the gateway: {found} ", end="")
    assert found <= HIGHEST_OF_THE_GATEWAY


def use(cell: Cell) -> None:
    """What people do with a dataflow works."""
    assert set(cell.status.nodes) == {"source", "doubler", "sink"}
    (before,) = cell.pids("node-sink")
    cell.doractl("node", "restart", cell.name, "sink")
    wait_for("another sink", lambda: cell.pids("node-sink") not in ([before], []))
    assert "doubler" in cell.doractl("dora", cell.name, "--", "node", "list").stdout
    cell.doractl("restart", cell.name)
    cell.wait_exchanging()


@pytest.mark.warns("is being restarted by dora")
def test_a_dataflow_in_each_level(
    cell: Cell, project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    """It works, and the levels differ by what systemd-analyze says of them."""
    found = {}
    for level in LEVELS:
        cell.start(project.three_nodes(), *([] if level == "default" else ["--sandbox", level]))
        cell.wait_exchanging()
        found[level] = exposure(cell.unit)
        rows = run("systemd-analyze", "security", "--json=short", "--no-pager", cell.unit).stdout
        weak = [row["json_field"] for row in json.loads(rows) if row.get("exposure")]
        assert "NoNewPrivileges" not in weak or level == "none"
        use(cell)
        cell.end()
    with capsys.disabled():
        print(f" exposure: {found} ", end="")
    assert found["strict"] < found["default"] <= HIGHEST < found["none"]


@pytest.mark.parametrize("level", LEVELS)
def test_user_scope(project: Project, level: str) -> None:
    alice = pwd.getpwnam("alice")
    runtime = f"/run/user/{alice.pw_uid}"
    wait_for("her manager", lambda: Path(runtime, "bus").exists())
    hers = Cell(f"hers-{level}", Scope(is_user=True, uid=alice.pw_uid))
    become = ("runuser", "-u", "alice", "--", "env", f"XDG_RUNTIME_DIR={runtime}", "doractl")
    start = ("start", str(project.three_nodes()), "--name", hers.name, "--sandbox", level)
    try:
        done = run(*become, *start)
        assert ("protects no files in user scope" in done.stderr) == (level == "strict")
        match = ("-o", "cat", f"DORA_DATAFLOW_NAME={hers.name}")
        wait_for("messages", lambda: "got [" in journalctl(*match, "DORA_NODE=sink"))
        row = json.loads(run(*become, "list", hers.name, "-o", "json").stdout)
        (pid,) = [one["pid"] for one in row["nodes"] if one["node"] == "sink"]
        status = Path(f"/proc/{pid}/status").read_text()
        assert ("NoNewPrivs:\t1" in status) == (level != "none")
    finally:
        run(*become, "stop", hers.name)


def test_files(cell: Cell, project: Project, place: Path) -> None:
    project.root.chmod(0o777)
    host = Path("/tmp/of-the-host")
    host.touch()
    tries = [f"write:{project.root}/x", f"write:{place}/x", "write:/tmp/y", f"read:{host}"]
    tries += ["write:/dev/shm/dora-systemd-test", f"read:{project.root}/probe.py"]
    try:
        found = probe(cell, project, "--uid", DEFAULT_USER, tries=tries)
    finally:
        host.unlink()
        Path("/dev/shm/dora-systemd-test").unlink(missing_ok=True)
    assert found == ["EROFS", "EROFS", "ok", "ENOENT", "ok", "ok"]
    assert not Path("/tmp/y").exists()


@pytest.mark.parametrize("level", ["default", "strict"])
def test_writable(cell: Cell, project: Project, place: Path, level: str) -> None:
    (project.root / "out").mkdir()
    (project.root / "out").chmod(0o777)
    flags = ["--sandbox", level, "--writable", str(place), "--writable", f"{project.root}/out"]
    tries = [f"write:{place}/x", f"write:{project.root}/out/x", f"write:{project.root}/x"]
    assert probe(cell, project, *flags, tries=tries) == ["ok", "ok", "EROFS"]
    assert (place / "x").read_text() == (project.root / "out" / "x").read_text() == "x"


def test_recordings_of_a_group(cell: Cell, project: Project, place: Path) -> None:
    """A directory that gives what is made in it to a group, as shared ones do."""
    audio = grp.getgrnam("audio").gr_gid
    os.chown(place, 0, audio)
    place.chmod(0o2777)
    assert probe(cell, project, "--writable", str(place), tries=[f"write:{place}/x"]) == ["ok"]
    made = (place / "x").stat()
    assert (made.st_uid, made.st_gid) == (pwd.getpwnam("dora").pw_uid, audio)


@pytest.mark.parametrize(
    ("level", "found"), [("none", "ok"), ("default", "ENOENT"), ("strict", "ENOENT")]
)
def test_another_dataflow_of_the_same_user(
    cell: Cell, project: Project, level: str, found: str
) -> None:
    """Its secrets may be in its memory and its environment, its coordinator's token in a file."""
    other = Cell("other")
    try:
        other.start(project.three_nodes(), "--sandbox", level)
        (pid,) = other.pids("node-sink")
        tries = [f"read:/proc/{pid}/environ", f"read:{other.paths.control}"]
        tries += [f"write:{cell.paths.root}/x", f"read:{cell.paths.control}"]
        assert probe(cell, project, "--sandbox", level, tries=tries) == [found, found, "ok", "ok"]
    finally:
        other.end()


@pytest.fixture
def closed() -> Iterator[Path]:
    """A file that all may read, below the home of bob, who lets nobody in."""
    home = Path("/home/bob")
    mode, there = home.stat().st_mode, home / "for-me"
    home.chmod(0o700)
    there.mkdir(mode=0o755)
    (there / "secret").touch(0o644)
    yield there / "secret"
    shutil.rmtree(there)
    home.chmod(mode)


@pytest.mark.parametrize(
    ("level", "around", "found"),
    [("default", "/tmp", "EACCES"), ("strict", "/home/alice", "ENOENT")],
)
def test_a_link_that_is_swapped_in(
    cell: Cell, project: Project, closed: Path, level: str, around: str, found: str
) -> None:
    """systemd mounts as root and follows links: it mounts nothing that alice can replace."""
    mine = Path(around) / "mine"
    mine.mkdir()
    (mine / "place").mkdir()
    for path in (mine, mine / "place"):
        shutil.chown(path, "alice", "alice")
    flags = ["--uid", "alice", "--sandbox", level, "--writable", str(mine / "place")]
    tries = [f"write:{mine}/place/x", f"read:{mine}/place/secret"]
    try:
        assert probe(cell, project, *flags, tries=tries) == ["ok", "ENOENT"]
        (mine / "place").rename(mine / "before")
        (mine / "place").symlink_to(closed.parent)
        seen = len(tried(cell))
        cell.systemctl("restart")
        (line,) = wait_for("the node tries again", lambda: tried(cell)[seen:])
        assert json.loads(line.partition(" ")[2])[tries[1]] == found
    finally:
        cell.end()
        shutil.rmtree(mine)


def test_none_writes_everywhere(cell: Cell, project: Project, place: Path) -> None:
    assert probe(cell, project, "--sandbox", "none", tries=[f"write:{place}/x"]) == ["ok"]


def test_a_property_has_the_last_word(cell: Cell, project: Project, place: Path) -> None:
    flags = ["--property", "ProtectSystem=no"]
    assert probe(cell, project, *flags, tries=[f"write:{place}/x"]) == ["ok"]


@pytest.mark.parametrize("level", ["default", "strict"])
@pytest.mark.parametrize(("home", "user"), [("/home/alice", "alice"), ("/root", "root")])
def test_projects_in_a_home(cell: Cell, home: str, user: str, level: str) -> None:
    """A home that only its owner may enter."""
    owner = pwd.getpwnam(user)
    mode = Path(home).stat().st_mode
    Path(home).chmod(0o700)
    mine = Project(Path(home) / "project")
    other = Path(home) / "secret"
    other.touch()
    try:
        for path in (mine.root, mine.write("probe.py", ""), mine.write("dataflow.yml", ""), other):
            os.chown(path, owner.pw_uid, owner.pw_gid)
        flags = ["--sandbox", level, "--uid", user]
        tries = [f"read:{home}/project/probe.py", f"write:{home}/project/x", f"read:{other}"]
        found = probe(cell, mine, *flags, tries=tries)
        assert found == ["ok", "EROFS", "ENOENT" if (user, level) == ("root", "strict") else "ok"]
    finally:
        cell.end()
        shutil.rmtree(mine.root)
        other.unlink()
        Path(home).chmod(mode)


@pytest.mark.warns("is being restarted by dora")
@pytest.mark.parametrize("network", NETWORKS)
def test_no_verb_is_poorer_in_any_network(
    cell: Cell, project: Project, front: Front, network: str
) -> None:
    cell.start(project.three_nodes(), "--network", network, "--debug")
    cell.wait_exchanging()
    (pid,) = cell.pids("node-sink")
    is_own = Path(f"/proc/{pid}/ns/net").readlink() != Path("/proc/self/ns/net").readlink()
    assert is_own == (network == "private")
    cell.doractl("node", "restart", cell.name, "sink")
    wait_for("another sink", lambda: cell.pids("node-sink") not in ([pid], []))
    cell.wait_exchanging()
    nodes = ("node", "list")
    assert "doubler" in cell.doractl("dora", cell.name, "--", *nodes).stdout
    echo = ("topic", "echo", "-d", cell.name, "doubler/double", "--count", "2", "--format", "json")
    assert cell.doractl("dora", cell.name, "--", *echo).stdout.count("data") >= 2
    front.up()
    gate = {**os.environ, "DORA_COORDINATOR_PORT": str(front.port)}
    assert "doubler" in run("dora", *nodes, env=gate).stdout
    assert run("dora", *echo, env=gate).stdout.count("data") >= 2
    wait_for("no relay is left", lambda: not relays())
    told = cell.doractl("env", cell.name, check=False)
    if network == "private":
        assert told.returncode == ExitCode.USAGE
        assert f"doractl --system dora {cell.name} -- ..." in told.stderr
    else:
        assert "DORA_DAEMON_LOCAL_LISTEN_PORT" in told.stdout
    cell.doractl("node", "stop", cell.name, "sink")
    wait_for("it is gone", lambda: not cell.pids("node-sink"))


def relays() -> list[str]:
    """What is left of `doractl dora`."""
    return run("pgrep", "-f", "doractl.* dora ", check=False).stdout.split()


def test_a_unit_file_is_the_same(cell: Cell, project: Project, place: Path) -> None:
    flags = ["--sandbox", "strict", "--writable", str(place), "--device", "/dev/null"]
    flow = project.three_nodes()
    cell.start(flow, *flags, "--enable")
    try:
        cell.wait_exchanging()
        before = exposure(cell.unit)
        cell.doractl("stop", cell.name)
        # Started from its file: the settings are the same.
        cell.start(flow, *flags)
        assert cell.show("FragmentPath").startswith("/etc/")
        cell.wait_exchanging()
        assert exposure(cell.unit) == before
    finally:
        cell.end()
        cell.doractl("disable", cell.name)


@pytest.fixture
def device() -> Iterator[Path]:
    """A device that no policy opens by itself."""
    there = [Path(one) for one in ("/dev/net/tun", "/dev/fuse", "/dev/loop-control", "/dev/ubda")]
    path = next(one for one in there if one.exists())
    mode = path.stat().st_mode
    path.chmod(0o666)
    yield path
    path.chmod(mode)


def test_devices_are_not_there_unless_there_is_no_sandbox(
    cell: Cell, project: Project, device: Path
) -> None:
    for flags, expected in (([], "ENOENT"), (["--sandbox", "none"], "ok")):
        assert probe(cell, project, *flags, tries=[f"read:{device}"]) == [expected], flags
        cell.end()


@pytest.mark.vm
def test_devices(cell: Cell, project: Project, device: Path) -> None:
    for named, expected in (("/dev/null", "EPERM"), (str(device), "ok")):
        flags = ("--device", named)
        assert probe(cell, project, *flags, tries=[f"read:{device}"]) == [expected], flags
        cell.end()


@pytest.mark.vm
def test_the_loopback_alone(cell: Cell, project: Project) -> None:
    run("ip", "link", "add", "sandbox0", "type", "dummy")
    try:
        run("ip", "address", "add", "10.99.0.1/24", "dev", "sandbox0")
        run("ip", "link", "set", "sandbox0", "up")
        tries = ["send:10.99.0.1", "send:10.99.0.2", "send:127.0.0.1"]
        found = probe(cell, project, "--network", "loopback", tries=tries)
        assert found == ["EPERM", "EPERM", "ok"]
    finally:
        run("ip", "link", "delete", "sandbox0")


def test_what_is_refused(cell: Cell, project: Project) -> None:
    flow = str(project.three_nodes())
    check_refusals(
        cell,
        project,
        [
            Refusal([flow, "--sandbox=strikt"], ExitCode.USAGE, "did you mean strict?"),
            Refusal([flow, "--network=lan"], ExitCode.USAGE, "host, loopback, private"),
            Refusal(
                [flow, "--writable=/nowhere"], ExitCode.BAD_INPUT, "install -d -o dora /nowhere"
            ),
        ],
    )
    project.write("dataflow.systemd.yml", "sandbox: 5\n")
    check_refusals(cell, project, [Refusal([flow], ExitCode.BAD_INPUT, "none, default or strict")])


RECORDER = """
from dora import Node
node = Node()
for event in node:
    open("recording", "w").close()
"""


@pytest.mark.warns("crashed", "exit code 1", "ExitCode(1)", "after failure", "Failed with")
def test_why_names_the_sandbox(cell: Cell, project: Project) -> None:
    project.root.chmod(0o777)
    project.write("probe.py", RECORDER)
    flow = project.write("dataflow.yml", FLOW)
    cell.start(flow, "--uid", DEFAULT_USER, check=False)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    sync_journal()
    text = cell.doractl("why", cell.name).stdout
    assert "Read-only file system: 'recording'" in text
    assert "--writable PATH allows one" in text

"""What the nodes of one dataflow write does not hinder anybody who looks at all of them."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, sync_journal, wait_for
from tests.system.gateways import Front
from tests.system.terminal import shown

# As root, whose verbs read what other users' nodes have written.
pytestmark = pytest.mark.lab

SECONDS = 5.0
"""Root's verbs answer within that, whatever nodes write."""
ORDERS = ("\x1b", "\x9b", "\u202e")

SLEEPER = "nodes: [{id: a, path: a.py, inputs: {tick: dora/timer/secs/1}}]\n"
NODE = "from dora import Node\nfor _event in Node():\n    pass\n"

TABLES: dict[str, Callable[[Path], object]] = {
    "fifo": os.mkfifo,
    "zero": lambda path: path.symlink_to("/dev/zero"),
    "infinity": lambda path: path.write_text('{"samples": [{"at_us": Infinity}]}'),
    "escape": lambda path: path.write_text('{"nodes": {"a\\u001b]0;x\\u0007": {}}}'),
    "deep": lambda path: path.write_text("[" * 1_000_000),
    "large": lambda path: path.write_text('{"nodes": {"a":' * 200_000),
}


def looked_at(cell: Cell, *words: str) -> str:
    """What a verb prints, in time and without anything for a terminal to obey."""
    begin = time.monotonic()
    done = cell.doractl(*words, check=False)
    assert time.monotonic() - begin < bound(SECONDS), words
    assert done.returncode in (ExitCode.OK, ExitCode.NOT_RUNNING), (words, done.stderr)
    text = done.stdout + done.stderr
    assert not any(one in text for one in ORDERS), (words, text)
    return done.stdout


def look_at_all(cell: Cell, front: Front) -> None:
    for words in (
        ["list"],
        ["list", cell.name],
        ["top", "--once"],
        ["why", cell.name],
        ["list", "-a"],
    ):
        assert cell.name in looked_at(cell, *words)
    assert json.loads(looked_at(cell, "list", "-o", "json"))
    reply = front.get("/metrics", "--max-time", str(SECONDS))
    assert reply.status == 200
    assert f'dora_dataflow_info{{dataflow="{cell.name}"' in reply.body


def started(cell: Cell, project: Project) -> Cell:
    project.write("a.py", NODE)
    cell.start(project.write("dataflow.yml", SLEEPER), "--uid", "alice")
    return cell


def test_tables(cell: Cell, project: Project, front: Front) -> None:
    front.up()
    started(cell, project)
    path = cell.paths.status
    for make in TABLES.values():
        # The runner would put its own in the place of ours.
        run("systemctl", "kill", "--kill-whom=main", "-s", "STOP", cell.unit)
        path.unlink(missing_ok=True)
        make(path)
        os.chown(path, 1000, 1000, follow_symlinks=False)
        look_at_all(cell, front)
        assert " ?  " in looked_at(cell, "list")
        run("systemctl", "kill", "--kill-whom=main", "-s", "CONT", cell.unit)
        wait_for("the table is there again", lambda: " 1/1 " in cell.doractl("list").stdout)


def test_groups(cell: Cell, project: Project, front: Front) -> None:
    """Their user has the tree below the unit's group, and makes there what he likes."""
    front.up()
    started(cell, project)
    script = (
        "import os, sys\n"
        "os.chdir(sys.argv[1])\n"
        "for name in ('node-\\x1b]0;x\\a', 'node-\\x9b', *map('node-{}'.format, range(3000))):\n"
        "    os.mkdir(name)\n"
        "for _ in range(200):\n"
        "    os.mkdir('d'); os.chdir('d')\n"
    )
    run("runuser", "-u", "alice", "--", "python3", "-c", script, str(cell.group))
    look_at_all(cell, front)
    assert "node-0" not in looked_at(cell, "list", cell.name)
    cell.paths.status.unlink()
    look_at_all(cell, front)


FORGER = r"""
import fcntl, json, os, socket, struct
from dora import Node

def send(**fields):
    data = b""
    for key, value in fields.items():
        value = value if isinstance(value, bytes) else value.encode()
        data += key.encode() + b"\n" + struct.pack("<Q", len(value)) + value + b"\n"
    journal = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        journal.sendto(data, "/run/systemd/journal/socket")
    except OSError:
        fd = os.memfd_create("x", os.MFD_ALLOW_SEALING)
        os.write(fd, data)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, 15)
        journal.connect("/run/systemd/journal/socket")
        socket.send_fds(journal, [b""], [fd])

name, uuid = os.environ["FLOW"], os.environ["FLOW_UUID"]
ids = json.loads(os.environ["IDS"])
for event, ident in ids.items():
    for value in (b"\x1b]0;x\x07", b"\xff\xfe", b"Infinity", b"9" * 5000, b"x" * 3_000_000):
        send(MESSAGE=value, MESSAGE_ID=ident, PRIORITY="6", DORA_EVENT=event, DORA_NODE=value[:60],
             DORA_DATAFLOW=uuid, DORA_DATAFLOW_NAME=name, DORA_EXIT=value, DORA_CAUSE=value,
             DORA_PEAK=value[:60], DORA_LIMIT=value[:60], DORA_RESTARTS=value, DORA_NODES=value,
             SYSLOG_IDENTIFIER=name + "/a")
        send(MESSAGE="x", MESSAGE_ID=ident, DORA_EVENT=event, DORA_DATAFLOW=value[:60],
             DORA_DATAFLOW_NAME="victim")
for _event in Node():
    pass
"""


def test_records(cell: Cell, project: Project, front: Front) -> None:
    """Life events that a node has forged, of its own dataflow and in the name of another one."""
    front.up()
    project.write("a.py", FORGER)
    flow = project.write("dataflow.yml", SLEEPER)
    ids = json.dumps({name: kind.message_id for name, kind in EVENTS.items()})
    cell.start(flow, "--uid", "alice", "--env", f"FLOW={cell.name}", "--env", f"IDS={ids}",
               "--env", "FLOW_UUID=44f30e60-107e-41d2-b6a8-b30cefc153ae")  # fmt: skip
    sync_journal()
    look_at_all(cell, front)
    assert "victim" not in looked_at(cell, "list", "-a")
    assert cell.doractl("why", "victim", check=False).returncode == ExitCode.NOT_FOUND


def test_a_link_in_a_users_directory(alice: Front, tmp_path: Path) -> None:
    """The maintainer script removes nothing behind it."""
    victim = tmp_path / "user/dora-gateway.socket.d"
    victim.mkdir(parents=True)
    (victim / "precious").touch()
    place = alice.scope.runtime_root / "systemd"
    away = place.with_name("systemd-away")
    own = place.with_name("dora-systemd")
    own.mkdir(exist_ok=True)
    os.chown(own, 1000, 1000)
    place.rename(away)
    try:
        place.symlink_to(tmp_path)
        run("sh", str(Path(__file__).parents[2] / "packaging/debian/dora-systemd.postrm"), "remove")
        assert (victim / "precious").exists()
        assert not own.exists()
    finally:
        place.unlink()
        away.rename(place)


def test_a_directory_whose_name_is_an_order(cell: Cell, project: Project) -> None:
    place = "evil\x1b]0;x\x07\u202e"
    project.write(f"{place}/a.py", NODE)
    cell.start(project.write(f"{place}/dataflow.yml", SLEEPER))
    for words in (["list", cell.name], ["status", cell.name], ["why", cell.name]):
        assert r"evil\x1b]0;x\x07\u202e" in looked_at(cell, *words)
    assert place in json.loads(looked_at(cell, "list", cell.name, "-o", "json"))["file"]


def test_lines_on_a_terminal(cell: Cell, project: Project) -> None:
    """Colours pass, orders are shown; in a pipe they are what the node wrote."""
    line = "\\x1b[32mgreen\\x1b[0m \\x1b]52;c;eA==\\x07 \\x9b2J"
    project.write("a.py", f'print("{line}", flush=True)\nfrom dora import Node\nNode()\n')
    flow = project.write("dataflow.yml", "nodes: [{id: a, path: a.py}]\n")
    command = ["doractl", "run", str(flow), "--name", cell.name]
    text = shown(*command)
    assert "\x1b[32mgreen\x1b[0m \\x1b]52;c;eA==\\x07 \\u009b2J" in text
    assert "\x1b[32mgreen\x1b[0m \x1b]52;c;eA==\x07 \x9b2J" in run(*command).stdout

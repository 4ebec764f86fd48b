"""Root is no tool of those whose dataflows it looks after: where does it say what?"""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.gateways import Front

pytestmark = pytest.mark.lab

FALSE_RUNNER = """
import json, os, socket, sys, threading
directory, port, run = sys.argv[1], int(sys.argv[2]), sys.argv[3]
os.chdir(directory)
access = {"port": port, "token": "x", "local_listen_port": 4712}
with open("control.json", "w") as file:
    json.dump(access, file)
with open("status.json") as file:
    status = json.load(file)
with open("status.json.new", "w") as file:
    json.dump({**status, "run": run}, file)
os.rename("status.json.new", "status.json")

def pass_on(one, other):
    while data := one.recv(65536):
        other.sendall(data)
    other.shutdown(socket.SHUT_WR)

if sys.argv[4] == "socket":
    os.unlink("runner.sock")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind("runner.sock")
    listener.listen()
print("ready", flush=True)
while sys.argv[4] == "socket":
    stream, _ = listener.accept()
    asked = stream.makefile().readline()
    if not asked:
        stream.close()
    elif json.loads(asked)["verb"] == "relay":
        stream.sendall(b'{"token": "x"}\\n')
        there = socket.create_connection(("127.0.0.1", port))
        for ends in ((stream, there), (there, stream)):
            threading.Thread(target=pass_on, args=ends, daemon=True).start()
    else:
        stream.sendall(json.dumps(access).encode() + b"\\n")
        stream.close()
sys.stdin.read()
"""


@contextmanager
def false_runner(cell: Cell, front: Front, run_id: str, kind: str) -> Iterator[None]:
    """What alice can put into the directory of her dataflow, from outside of it."""
    words = [str(cell.paths.root), str(front.port), run_id, kind]
    command = ["runuser", "-u", "alice", "--", sys.executable, "-c", FALSE_RUNNER, *words]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout
        assert child.stdout.readline() == "ready\n"
        yield
        run("pkill", "--parent", str(child.pid), check=False)


@pytest.fixture
def other(project: Project) -> Iterator[Cell]:
    """A dataflow that alice may not touch."""
    cell = Cell("others")
    cell.start(project.three_nodes())
    yield cell
    cell.end()


@pytest.mark.parametrize("kind", ["file", "socket"])
def test_root_asks_nobody_else_for_alice(
    cell: Cell, project: Project, other: Cell, front: Front, kind: str
) -> None:
    """The gateway does what root asks for: alice would have root ask it to end what is not hers."""
    front.up()
    cell.start(project.root / "dataflow.yml", "--uid", "alice")
    cell.wait_exchanging()
    (before,) = other.pids("node-sink")
    uuid = json.loads(run("doractl", "list", other.name, "-o", "json").stdout)["uuid"]
    with false_runner(cell, front, uuid, kind):
        cell.doractl("node", "stop", cell.name, "sink", check=False)
        told = cell.doractl("env", cell.name, check=False)
    other.wait_exchanging()
    assert other.pids("node-sink") == [before]
    if kind == "socket":
        assert told.returncode == ExitCode.NO_PERMISSION
        assert "root listens there, not alice" in told.stderr


def test_a_socket_of_somebody_else(cell: Cell, project: Project) -> None:
    """One that bob has made, and that alice has put into her directory."""
    cell.start(project.three_nodes(), "--uid", "alice")
    mine = cell.paths.socket.with_name("mine")
    cell.paths.socket.rename(mine)
    room = Path("/run/of-bob")
    room.mkdir()
    shutil.chown(room, "bob")
    place = room / "socket"
    code = f"import socket; socket.socket(socket.AF_UNIX).bind({str(place)!r})"
    run("runuser", "-u", "bob", "--", sys.executable, "-c", code)
    for put in (place.rename, lambda path: path.symlink_to("/run/systemd/notify")):
        put(cell.paths.socket)
        done = cell.doractl("reload", cell.name, check=False)
        assert done.returncode == ExitCode.NO_PERMISSION
        assert "cannot connect to" in done.stderr
        cell.paths.socket.unlink()
    room.rmdir()
    mine.rename(cell.paths.socket)
    assert "Nothing has changed" in wait_for(
        "the runner", lambda: cell.doractl("reload", cell.name, check=False).stdout
    )

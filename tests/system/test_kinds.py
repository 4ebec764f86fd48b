"""Every kind of node: in its own group, heard by the journal, in the project's directory."""

import json
import os
import re
from pathlib import Path

import pytest

from dora_systemd.verbs.start.where import DEFAULT_USER
from tests.system.cells import Cell, Project, command_line, run, wait_for

TICK = "inputs: {tick: dora/timer/millis/50}"
SPEAKER = """
import os
from dora import Node
node = Node()
print("cwd", os.getcwd(), flush=True)
for event in node:
    if event["type"] == "INPUT":
        print("tick", flush=True)
"""


def check(cell: Cell, node: str, directory: Path | str) -> None:
    """The node runs in its group and its lines arrive, with the directory it is in."""
    wait_for(f"{node} speaks", lambda: "tick" in cell.messages(node))
    pids = cell.pids(f"node-{node}")
    assert cell.status.nodes[node].pid in pids
    assert len(cell.pids("supervisor")) == 3, "runner, coordinator and daemon"
    assert f"cwd {directory}" in cell.messages(node)


def flow_of(project: Project, node: str) -> Path:
    """A dataflow of one node."""
    return project.write("dataflow.yml", f"nodes:\n  - {{id: one, {TICK}, {node}}}\n")


def make_venv(venv: Path) -> None:
    """A virtual environment that finds the dora of this one."""
    run("python3", "-m", "venv", "--without-pip", str(venv))
    found = run("python3", "-c", "import dora; print(dora.__path__[0])").stdout.strip()
    site = next((venv / "lib").iterdir()) / "site-packages"
    (site / "lab.pth").write_text(f"{Path(found).parent}\n")


def test_python_in_a_venv(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER + "\n    import sys; print('prefix', sys.prefix)\n")
    venv = project.root / ".venv"
    make_venv(venv)
    cell.start(flow_of(project, "path: speaker.py"))
    check(cell, "one", project.root)
    wait_for("it told", lambda: f"prefix {venv}" in cell.messages("one"))


def test_executable(cell: Cell, project: Project) -> None:
    path = project.write("speaker", "#!/usr/bin/env python3\n" + SPEAKER)
    path.chmod(0o755)
    cell.start(flow_of(project, "path: speaker, args: '-x \"a b\"'"))
    check(cell, "one", project.root)
    words = command_line(cell.status.nodes["one"].pid)
    assert list(words[-3:-1]) == ["-x", "a b"]


def test_shell(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    flow = flow_of(project, "path: shell, args: 'echo hello >&2; exec python3 -u speaker.py'")
    refused = cell.start(flow, check=False)
    assert refused.returncode == 5
    assert "--allow-shell-nodes" in refused.stderr
    assert cell.show("LoadState") == "not-found"
    cell.start(flow, "--allow-shell-nodes")
    check(cell, "one", project.root)
    assert "hello" in cell.messages("one")


def test_uv(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    cell.start(flow_of(project, "path: speaker.py"), "--uv", "--env", "UV_OFFLINE=1",
               "--env", "UV_CACHE_DIR=/tmp/uv")  # fmt: skip
    assert cell.status.nodes["one"].kind == "uv"
    check(cell, "one", project.root)


@pytest.mark.warns("crashed", "exit code 2", "ExitCode(2)", "Failed to start", "Failed with")
def test_a_node_that_is_uv_itself(cell: Cell, project: Project) -> None:
    """It cannot write the cache of uv; what the hint says gives it one."""
    project.write("speaker.py", SPEAKER)
    words = "run --offline --no-project python3 speaker.py"
    flow = flow_of(project, f"path: uv, args: {words}")
    failed = cell.start(flow, "--uid", DEFAULT_USER, check=False)
    assert failed.returncode != 0
    (hint,) = re.findall(r"--property CacheDirectory=NAME --env \S+", failed.stderr)
    cell.start(flow, "--uid", DEFAULT_USER, *hint.replace("NAME", cell.name).split())
    check(cell, "one", project.root)


@pytest.mark.warns("before initializing")
def test_uv_in_a_workspace(cell: Cell, project: Project) -> None:
    """uv puts .venv and uv.lock beside the pyproject.toml of the workspace."""
    project.write("apps/robot/one.py", "import sys\nprint('prefix', sys.prefix)\n")
    project.write("apps/robot/pyproject.toml", '[project]\nname = "robot"\nversion = "1"\n')
    project.write("pyproject.toml", '[tool.uv.workspace]\nmembers = ["apps/*"]\n')
    flow = project.write("apps/robot/dataflow.yml", "nodes: [{id: one, path: one.py}]\n")
    run("chown", "-R", "alice:alice", str(project.root))
    words = ("--uv", "--env", "UV_OFFLINE=1", "--env", "UV_CACHE_DIR=/tmp/uv")
    done = cell.doractl("run", str(flow), "--name", cell.name, *words)
    assert f"prefix {project.root}/.venv" in done.stdout


@pytest.mark.warns("before initializing")
def test_a_project_that_uv_builds(cell: Cell, project: Project) -> None:
    """`doractl build --uv` of root makes the .venv of a project with a lock, as its owner."""
    project.write("one.py", "import robot_parts\nprint('arms', robot_parts.ARMS)\n")
    project.write("parts/robot_parts.py", "ARMS = 2\n")
    project.write("pyproject.toml", '[project]\nname = "robot"\nversion = "1"\n')
    flow = project.write("dataflow.yml", "nodes: [{id: one, path: one.py}]\n")
    run("chown", "-R", "alice:alice", str(project.root))
    uv = ("env", "HOME=/home/alice", "UV_OFFLINE=1", "uv", "lock", f"--project={project.root}")
    run("setpriv", "--reuid=alice", "--regid=alice", "--init-groups", *uv)
    cell.doractl("build", str(flow), "--uv", "--env", "UV_OFFLINE=1")
    venv = project.root / ".venv"
    assert venv.owner() == "alice"
    (library,) = venv.glob("lib/python3*/site-packages")
    (library / "parts.pth").write_text(str(project.root / "parts"))
    done = cell.doractl("run", str(flow), "--name", cell.name, "--uv", "--env", "UV_OFFLINE=1")
    assert "arms 2" in done.stdout


def test_module(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    project.write(
        "inner.yml",
        "module:\n  name: inner\n  inputs: [tick]\n  outputs: []\n"
        "nodes:\n  - {id: one, path: speaker.py, inputs: {tick: _mod/tick}}\n",
    )
    flow = project.write("dataflow.yml", f"nodes:\n  - {{id: m, module: inner.yml, {TICK}}}\n")
    cell.start(flow)
    check(cell, "m.one", project.root)


def test_operator(cell: Cell, project: Project) -> None:
    project.write(
        "op.py",
        "import os\nfrom dora import DoraStatus\n"
        "class Operator:\n"
        "    def __init__(self):\n        print('cwd', os.getcwd(), flush=True)\n"
        "    def on_event(self, event, send_output):\n"
        "        if event['type'] == 'INPUT':\n            print('tick', flush=True)\n"
        "        return DoraStatus.CONTINUE\n",
    )
    flow = project.write(
        "dataflow.yml",
        f"nodes:\n  - id: one\n    operator: {{python: op.py, {TICK}}}\n"
        f"    deploy: {{machine: {os.uname().nodename}}}\n",
    )
    cell.start(flow)
    check(cell, "one", project.root)
    assert cell.status.nodes["one"].kind == "operator"


def test_output_that_dora_itself_sends_on(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    project.write(
        "listener.py",
        "from dora import Node\nfor event in Node():\n"
        "    if event['type'] == 'INPUT':\n        print('heard', event['value'], flush=True)\n",
    )
    flow = project.write(
        "dataflow.yml",
        f"nodes:\n  - {{id: one, path: speaker.py, {TICK}, send_stdout_as: out, outputs: [out]}}\n"
        "  - {id: two, path: listener.py, inputs: {words: {source: one/out, queue_size: 1000}}}\n",
    )
    cell.start(flow)
    check(cell, "one", project.root)
    wait_for("it was sent on", lambda: any("tick" in line for line in cell.messages("two")))


@pytest.mark.warns("failed to receive finished signal")
def test_dynamic(cell: Cell, project: Project) -> None:
    """The runner waits for nobody who comes from outside; who comes finds the cell."""
    project.write("speaker.py", SPEAKER)
    flow = project.write(
        "dataflow.yml",
        f"nodes:\n  - {{id: one, path: speaker.py, {TICK}}}\n"
        f"  - {{id: guest, path: dynamic, {TICK}}}\n",
    )
    cell.start(flow)
    assert cell.status.nodes["guest"].state == "dynamic"
    assert cell.show("StatusText") == "2/2 nodes running"
    port = json.loads(cell.paths.control.read_text())["local_listen_port"]
    guest = "from dora import Node\nnode = Node('guest')\nprint(node.next()['type'])\n"
    environment = {**os.environ, "DORA_DAEMON_LOCAL_LISTEN_PORT": str(port)}
    said = run("python3", "-c", guest, env=environment, cwd=project.root).stdout
    assert "INPUT" in said


def test_built_from_git(cell: Cell, project: Project) -> None:
    origin = project.root / "origin"
    project.write("origin/speaker.py", SPEAKER)
    git = ("git", "-C", str(origin), "-c", "user.email=a@example.org", "-c", "user.name=a")
    run("git", "init", "--quiet", str(origin))
    run(*git, "add", ".")
    run(*git, "commit", "--quiet", "--message", "one")
    flow = flow_of(project, f"path: speaker.py, git: 'file://{origin}', build: 'true'")
    unbuilt = cell.start(flow, check=False)
    assert unbuilt.returncode == 5
    assert f"doractl build {flow}" in unbuilt.stderr
    if os.geteuid() == 0:
        root_only = cell.doractl("build", str(flow), check=False)
        assert "user dora cannot write in" in root_only.stderr
        run("chown", "-R", "dora", str(project.root))
    built = cell.doractl("build", str(flow)).stdout
    assert "running build command: `true`" in built
    assert built.endswith(f"Dataflow built: {flow}\nUse 'doractl start {flow}' to start\n")
    cell.start(flow)
    clone = next((project.root / "git").rglob("speaker.py")).parent
    check(cell, "one", clone)


def test_built_with_uv(cell: Cell, project: Project) -> None:
    """The session as `dora build --uv` of dora 1.1 writes it; to run that needs the network."""
    project.write("speaker.py", SPEAKER + "        import sys; print('prefix', sys.prefix)\n")
    flow = flow_of(project, "path: speaker.py, build: 'true'")
    env = project.root / ".dora" / "python-envs" / "one"
    make_venv(env)
    project.write(
        "out/dataflow.dora-session.yaml",
        "build_id: 01a1fb98-c7b4-7b75-b0dd-6baa317c6e37\n"
        "session_id: 01a1fb98-c586-7345-bc00-1872b359d994\ngit_sources: {}\nlocal_build:\n"
        f"  node_working_dirs:\n    one: {project.root}\n"
        f"  python_env_dirs:\n    one: {env}\n  confined_nodes: []\n",
    )
    cell.start(flow, "--uv")
    check(cell, "one", project.root)
    wait_for("it told", lambda: f"prefix {env}" in cell.messages("one"))

"""What doractl start refuses: one line and a hint, the exit status, and nothing left behind."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project
from tests.system.refusals import IN_THE_JOURNAL, Refusal, check_refusals, units

pytestmark = pytest.mark.warns(*IN_THE_JOURNAL)

TICK = "inputs: {tick: dora/timer/millis/50}"


BAD_FILES = {
    "empty": "",
    "comment": "# nothing\n",
    "no-yaml": "nodes: [",
    "text": "hello",
    "list": "[1, 2]",
    "no-nodes": "nodes: []",
    "nul": "nodes:\0",
    "unknown-key": f"nodes: [{{id: a, path: source.py, colour: red, {TICK}}}]",
    "unknown-root-key": f"colour: red\nnodes: [{{id: a, path: source.py, {TICK}}}]",
    "double-id": "nodes: [{id: a, path: source.py}, {id: a, path: source.py}]",
    "no-path": "nodes: [{id: a, path: nowhere.py}]",
    "from-nowhere": "nodes: [{id: a, path: source.py, inputs: {x: b/y}}]",
    "no-such-output": "nodes: [{id: a, path: source.py}, {id: b, path: sink.py, inputs: {x: a/y}}]",
    "id-up": "nodes: [{id: ../x, path: source.py}]",
    "bomb": "a: &a [x, x]\n"
    + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    + "nodes: *j\n",
}


def test_bad_dataflows(cell: Cell, project: Project) -> None:
    project.three_nodes()
    flows = [project.write(f"{kind}.yml", text) for kind, text in BAD_FILES.items()]
    check_refusals(
        cell, project, [Refusal([str(flow)], ExitCode.BAD_INPUT, flow.name) for flow in flows]
    )


def test_an_input_that_dora_cannot_read(cell: Cell, project: Project) -> None:
    """dora does not say which; the error names it and its value."""
    project.three_nodes()
    text = "nodes: [{id: a, path: source.py, inputs: {tick: dora/timer/millis/5milis}}]"
    flow = project.write("input.yml", text)
    told = "nodes[0].inputs.tick: 'dora/timer/millis/5milis' is not a timer such as"
    check_refusals(cell, project, [Refusal([str(flow)], ExitCode.BAD_INPUT, told)])


def test_a_dataflow_that_is_no_file(cell: Cell, project: Project) -> None:
    os.mkfifo(project.root / "pipe.yml")
    huge = project.write("huge.yml", "")
    with huge.open("wb") as file:
        file.truncate(100 << 20)
    names = (".", "missing.yml", "pipe.yml", "huge.yml", "x/dataflow.yml", "a\nb.yml")
    check_refusals(
        cell,
        project,
        [Refusal([str(project.root / name)], ExitCode.BAD_INPUT, "cannot") for name in names],
    )


BAD_NAMES = ("a/b", "../x", "-x", "x.service", "ä", "x" * 300, "", ".", "a b", "gateway", "a\nb")


def test_bad_names(cell: Cell, project: Project) -> None:
    flow = str(project.three_nodes())
    check_refusals(
        cell,
        project,
        [Refusal([flow, f"--name={name}"], ExitCode.USAGE, "name") for name in BAD_NAMES],
    )


BAD_OPTIONS = {
    "--env=NOVALUE": ExitCode.USAGE,
    "--env=A=b\nc": ExitCode.USAGE,
    "--env=1A=b": ExitCode.USAGE,
    "--env=NOTIFY_SOCKET=x": ExitCode.USAGE,
    "--env-file=/nowhere": ExitCode.BAD_INPUT,
    "--env-file=/": ExitCode.BAD_INPUT,
    "--grace-duration=soon": ExitCode.USAGE,
    "--log-rate-limit=fast": ExitCode.USAGE,
    "--node=sorce:log_rate_limit=5/1s": ExitCode.BAD_INPUT,
    "--property=Nice": ExitCode.USAGE,
    "--property=Nice=50": ExitCode.USAGE,
    "--property=ExecStart=/bin/true": ExitCode.USAGE,
    "--property=Nise=5": ExitCode.USAGE,
    "--venv=/nowhere": ExitCode.BAD_INPUT,
    "--working-directory=/nowhere": ExitCode.BAD_INPUT,
    "--dora=/nowhere": ExitCode.NO_DORA,
    "--dora=/bin/false": ExitCode.NO_DORA,
    "--dora=/bin/echo": ExitCode.NO_DORA,
    "--uid=no-such-user": ExitCode.USAGE,
    "--uid=99999999999999999999": ExitCode.USAGE,
}


def test_bad_options(cell: Cell, project: Project) -> None:
    flow = str(project.three_nodes())
    check_refusals(
        cell,
        project,
        [Refusal([flow, option], code, "cannot") for option, code in BAD_OPTIONS.items()],
    )


def test_a_dora_that_is_too_old(cell: Cell, project: Project) -> None:
    old = project.write("dora", "#!/bin/sh\necho dora-cli 0.4.1\n")
    old.chmod(0o755)
    words = [str(project.three_nodes()), f"--dora={old}"]
    check_refusals(cell, project, [Refusal(words, ExitCode.NO_DORA, "0.4.1")])


HALF_WRITTEN = (
    "memory_limit: [4G\n",
    "memory_lim",
    "env: {A: x, B",
    'env_file: "/srv',
    "nodes:\n  sin",
)


@pytest.mark.lab
@pytest.mark.parametrize("place", ["beside", "of-the-machine"])
def test_half_written_settings(cell: Cell, project: Project, place: str) -> None:
    """Refused by name; what runs and is started again has its settings in its unit."""
    flow = project.three_nodes()
    cell.start(flow)
    path = project.root / "dataflow.systemd.yml"
    if place != "beside":
        path = Path("/etc/dora-systemd/config.yml")
    path.parent.mkdir(exist_ok=True)
    try:
        for text in HALF_WRITTEN:
            path.write_text(text)
            words = [str(flow), "--name", "other"]
            check_refusals(cell, project, [Refusal(words, ExitCode.BAD_INPUT, str(path))])
        cell.doractl("restart", cell.name)
    finally:
        path.unlink()
    cell.wait_exchanging()


def test_every_way_of_starting_refuses_the_same(cell: Cell, project: Project) -> None:
    """What only the cell finds out, too: said in the same words, and nothing is left behind."""
    project.three_nodes()
    flow = str(project.write("flow.yml", BAD_FILES["unknown-key"]))
    before, said = units(), set()
    for verb, *words in (
        ("start",),
        ("start", "--no-wait"),
        ("start", "--dry-run"),
        ("start", "--enable"),
        ("run",),
    ):
        done = cell.doractl(verb, flow, "--name", cell.name, *words, check=False)
        assert (done.returncode, done.stdout) == (ExitCode.BAD_INPUT, ""), (verb, words)
        said.add(done.stderr)
        assert units() == before, (verb, words)
    (words_of_all,) = said
    assert "colour" in words_of_all
    assert not cell.systemctl("list-unit-files", "--no-legend", check=False)


def test_a_restart_that_would_be_refused_stops_nothing(cell: Cell, project: Project) -> None:
    """It says what a start says, or a reload of a program; the dataflow runs on."""
    flow = project.three_nodes()
    cell.start(flow)
    good, main_pid = flow.read_text(), cell.show("MainPID")
    flow.write_text(BAD_FILES["unknown-key"])
    started = cell.doractl("start", str(flow), "--name", f"{cell.name}-2", check=False)
    broken = cell.doractl("restart", cell.name, check=False)
    assert (broken.returncode, broken.stdout) == (ExitCode.BAD_INPUT, "")
    assert broken.stderr.splitlines()[0] == started.stderr.splitlines()[0]
    assert "keeps running" in broken.stderr
    flow.write_text(good)
    (project.root / "sink.py").write_text("def (")
    broken = cell.doractl("restart", cell.name, check=False)
    assert broken.returncode == ExitCode.BAD_INPUT
    assert "sink.py: line 1: invalid syntax" in broken.stderr
    assert cell.show("MainPID") == main_pid
    project.three_nodes()
    cell.doractl("restart", cell.name)
    assert cell.show("MainPID") != main_pid


def link_venv(venv: Path, python: Path) -> None:
    """A virtual environment with that Python, as uv and python3 -m venv make it."""
    shutil.rmtree(venv, ignore_errors=True)
    (venv / "bin").mkdir(parents=True)
    (venv / "pyvenv.cfg").write_text("home = /usr/bin\nversion = 3.13.5\n")
    (venv / "bin/python").symlink_to(python)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root starts the nodes of others")
def test_pythons_that_the_user_of_the_nodes_cannot_execute(cell: Cell, project: Project) -> None:
    """Refused by name, never by an exit status of systemd; the others start."""
    flow, venv = project.three_nodes(), project.root / ".venv"
    own = Path("/usr/bin/python3").resolve()
    with tempfile.TemporaryDirectory(dir="/root") as hidden:
        uvs = shutil.copy2(own, f"{hidden}/python3")
        foreign = Path(project.root / "foreign")
        head = own.read_bytes()[:64]
        machine = {62: 183}.get(int.from_bytes(head[18:20], "little"), 62)
        foreign.write_bytes(head[:18] + machine.to_bytes(2, "little") + head[20:])
        foreign.chmod(0o755)
        bad = {
            Path(uvs): "is behind /root, which user dora cannot enter",
            Path("/opt/removed/bin/python3"): "/opt/removed/bin/python3, does not exist",
            foreign: "and this machine is",
        }
        if any(Path("/proc/sys/fs/binfmt_misc").glob("qemu-*")):
            del bad[foreign]  # it can be executed
        for python, expected in bad.items():
            link_venv(venv, python)
            done = cell.start(flow, check=False)
            assert expected in done.stderr, (python, done.stderr)
            assert done.stderr.startswith(f"doractl: cannot use {venv}/bin/python: the program ")
            assert done.stderr.count("\n") == 2
    conda = project.root / "conda"
    (conda / "bin").mkdir(parents=True)
    shutil.copy2(own, conda / "bin/python")
    link_venv(venv, own)
    for words in ((), ("--venv", str(conda))):
        done = cell.start(flow, "--dry-run", *words)
        assert "ExecStart=" in done.stdout

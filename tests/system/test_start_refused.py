"""What doractl start refuses: one line and a hint, the exit status, and nothing left behind."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run

TICK = "inputs: {tick: dora/timer/millis/50}"


def units() -> list[str]:
    """All units of dataflows that systemd knows."""
    listed = run("systemctl", "list-units", "--all", "--plain", "--no-legend", "dora-*.service")
    return [line.split()[0] for line in listed.stdout.splitlines()]


def files_of(*places: Path) -> set[str]:
    """Every file below the places."""
    return {str(path) for place in places for path in place.rglob("*")}


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


class Refusal(NamedTuple):
    """Words behind `start`, the exit status, and a part of the line that says what is wrong."""

    words: list[str]
    code: ExitCode
    part: str


def check_refusals(cell: Cell, project: Project, refusals: Sequence[Refusal]) -> None:
    """Each is refused in one line and a hint, and nothing is left of any."""
    places = (project.root, Path("/run/dora-systemd"))
    files, before = files_of(*places), units()
    for one in refusals:
        check_refusal(cell, one)
    assert files_of(*places) == files
    assert units() == before


def check_refusal(cell: Cell, refusal: Refusal) -> None:
    words = refusal.words
    name = [] if any(word.startswith("--name") for word in words) else ["--name", cell.name]
    done = cell.doractl("start", *words, *name, check=False)
    lines = done.stderr.splitlines()
    assert done.returncode == refusal.code, (words, done.stderr)
    assert done.stdout == "", words
    assert len(lines) == 2, (words, lines)
    assert lines[0].startswith("doractl: cannot "), words
    assert refusal.part in lines[0], words
    assert lines[1].startswith("hint: "), words

"""A running cell says whether its dataflow could start again."""

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.runner.cell.life import Life
from dora_systemd.runner.cell.role import Alone
from dora_systemd.runner.recheck import Recheck
from tests.unit.fakes.programs import make_dora

FLOW = "nodes: [{id: a, path: a.py, outputs: [x]}]"


@pytest.fixture
def options(tmp_path: Path) -> RunnerOptions:
    (tmp_path / "a.py").write_text("import b\n")
    (tmp_path / "b.py").write_text("")
    (flow := tmp_path / "robot.yml").write_text(FLOW)
    return RunnerOptions(
        "robot", "", str(flow), str(tmp_path), make_dora(tmp_path / "dora", "1.1.0")
    )


def ask(options: RunnerOptions, **request: Any) -> dict[str, Any]:
    async def others(request: Any) -> dict[str, Any]:
        return {"done": [request["verb"]]}

    role = Alone(options, Life(options.uuid))
    return asyncio.run(Recheck(role, os.environ, others).answer(request))


def test_what_could_start(options: RunnerOptions) -> None:
    assert ask(options, verb="check") == {"refused": None}


def test_all_other_requests(options: RunnerOptions) -> None:
    assert ask(options, verb="reload") == {"done": ["reload"]}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("robot.yml", FLOW.replace("path:", "pth:"), "node a has no path"),
        ("a.py", "def (", "line 1: invalid syntax"),
        ("b.py", "def (", "line 1: invalid syntax"),
        ("robot.yml", "", "robot.yml"),
    ],
)
def test_what_could_not(options: RunnerOptions, name: str, text: str, words: str) -> None:
    Path(options.working_directory, name).write_text(text)
    refused = ask(options, verb="check")["refused"]
    assert words in refused["error"]
    assert name in refused["error"]

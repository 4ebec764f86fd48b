"""The Tab key in bash, zsh and fish: the names of what runs, after `doractl setup`."""

import json
from collections.abc import Iterator

import pytest

from tests.system.cells import Cell, Project, run
from tests.system.shells import SHELLS

# `doractl setup` puts the scripts where the shells of everybody look.
pytestmark = pytest.mark.lab


@pytest.fixture(scope="module", autouse=True)
def installed() -> Iterator[None]:
    run("doractl", "setup")
    yield
    run("doractl", "setup", "--remove")


@pytest.mark.parametrize("shell", SHELLS)
def test_dataflows_and_nodes_that_run(shell: str, cell: Cell, project: Project) -> None:
    ask = SHELLS[shell]
    cell.start(project.three_nodes())
    begun = cell.name[:-1]
    for verb in ("stop", "node restart", "logs --follow"):
        assert ask(f"doractl {verb} {begun}", ()) == [cell.name]
    (row,) = json.loads(cell.doractl("list", "-o", "json").stdout)
    assert ask(f"doractl --system show {row['uuid'][:8]}", ()) == [row["uuid"]]
    assert ask(f"doractl node restart {cell.name} so", ()) == ["source"]
    nodes = f"doractl logs {cell.name} --node d"
    assert ask(nodes, ()) == ["doubler"], f"bash: {SHELLS['bash'](nodes, ())}"
    assert cell.name not in ask(f"doractl stop {cell.name} {begun}", ()), "it is given already"
    assert ask("doractl sto", ()) == ["stop"]
    cell.doractl("stop", cell.name)
    assert cell.name not in ask("doractl stop ", ())

"""Dataflows made of a seed do the same under `dora run` and `doractl run`.

FLOWS=200 in the environment makes so many of them.
"""

import os
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project
from tests.system.fidelity.flows import Flow, make_flow
from tests.system.fidelity.ways import read_outcome, run_both

FLOWS = int(os.environ.get("FLOWS", "12"))
FAILURES = (
    *("exited", "node_failure", "crashed", "failed", "Failed", "killed", "restart"),
    "not valid UTF-8",  # dora's, of a line that it reads itself
)
CALLER = {"CALLER": "ca ller"}


def written(project: Project, flow: Flow) -> Path:
    """The file of the dataflow, among its other files."""
    for name, text in flow.files.items():
        project.write(name, text).chmod(0o755)
    return project.write("dataflow.yml", flow.text)


@pytest.mark.warns(*FAILURES)
@pytest.mark.parametrize("seed", range(FLOWS))
def test_generated(cell: Cell, project: Project, seed: int) -> None:
    flow = make_flow(seed)
    path = written(project, flow)
    bare, ours = run_both(path, cell, CALLER, "--allow-shell-nodes")
    print(flow.text, bare.stdout, bare.stderr, ours.stdout, ours.stderr, sep="\n")
    expected = read_outcome(bare.returncode, bare.stdout)
    assert sorted(expected.said) == sorted(flow.idents)
    assert read_outcome(ours.returncode, ours.stdout) == expected

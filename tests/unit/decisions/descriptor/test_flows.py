"""The dataflows of tests/system/fidelity are read, and every program can be launched."""

from pathlib import Path

import pytest

from dora_systemd.adapters.host.files import parse_yaml
from dora_systemd.decisions.cell.launch import LaunchPlan, launch_descriptor
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from tests.system.fidelity.flows import make_flow

FILE = Path("/project/dataflow.yml")
OPTIONS = RunnerOptions("robot", "", str(FILE), "/project", "/dora", allow_shell_nodes=True)
PLAN = LaunchPlan(OPTIONS, "/launcher.pl", "/bin", lambda _: True, lambda _: b"")


@pytest.mark.parametrize("seed", range(100))
def test_any_seed(seed: int) -> None:
    flow = make_flow(seed)
    assert make_flow(seed) == flow
    dataflow = parse_dataflow(parse_yaml(flow.text, FILE), str(FILE))
    assert tuple(node.id for node in dataflow.nodes) == flow.idents
    assert launch_descriptor(dataflow, PLAN)["nodes"]
    for name, text in flow.files.items():
        compile(text, name, "exec")

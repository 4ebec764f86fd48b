"""The page in a real browser, with what the gateway of a head sends: nodes on other machines."""

import json
from dataclasses import replace

import pytest

from dora_systemd.decisions.resources.usage import Strain, Usage
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed, observed_values
from dora_systemd.values import SECOND
from tests.system.chromium import Browser

pytestmark = [pytest.mark.lab, pytest.mark.browser]

NODES = (
    NodeRow("camera", "running", 101, 12.5, 1 << 20, restarts=0),
    NodeRow("yolo", "running", 0, 61.0, 96 << 20, restarts=2, machine="gpu"),
)
ROBOT = DataflowRow("u", "robot", "dora-robot.service", "Running", nodes=NODES, machines=("gpu",))
FIRST = Observed(
    ROBOT,
    SECOND,
    usage={"": Usage(0), "camera": Usage(SECOND), "yolo": Usage(9 * SECOND)},
    strains={"": Strain(), "camera": Strain()},
)
SECOND_ONE = replace(
    FIRST,
    at_us=3 * SECOND,
    usage={"": Usage(0), "camera": Usage(2 * SECOND), "yolo": Usage(9 * SECOND)},
)
SHOW = """(async () => {
  const { History } = await import("/page/history.js");
  const { NodeRow } = await import("/page/nodes.js");
  const history = new History();
  const snapshots = %s;
  for (const one of snapshots) history.add([one]);
  const shown = snapshots[1].nodes.map((facts) => {
    const row = new NodeRow(facts.node, () => 0, () => 0);
    row.show(facts, history.of("u", facts.node), false, true);
    return row.node.textContent;
  });
  return [shown, history.of("u", "camera").cpu, history.of("u", "yolo").cpu];
})()"""


def test_nodes_on_other_machines(browser: Browser) -> None:
    """Their CPU is what the member has measured: a counter that comes now and then makes none."""
    snapshots = json.dumps([observed_values(one) for one in (FIRST, SECOND_ONE)])
    (camera, yolo), here, there = browser.js(SHOW % snapshots)
    assert "on head" in camera
    assert "on gpu" in yolo
    assert here == [12.5, 50.0]
    assert there == [61.0, 61.0]
    assert "61" in yolo
    assert "96" in yolo
    assert browser.failures() == []

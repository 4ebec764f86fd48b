"""Nodes on another machine that fail, or that their watchdog ends: the head knows which and why."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.journals import AGAIN, announced
from tests.system.cells import DOUBLER, wait_for

FAILS = DOUBLER + "        if event['value'][0].as_py() > 40:\n            raise SystemExit(3)\n"


@dataclass(frozen=True)
class Essential(Flow):
    """Its doubler, on b, is essential. program: its text. watchdog: its setting, or ""."""

    program: str = DOUBLER
    watchdog: str = ""

    def write(self) -> None:
        super().write()
        watchdog = {"watchdog": self.watchdog} if self.watchdog else {}
        settings = {"nodes": {"doubler": {"essential": True, **watchdog}}}
        (Path(PLACE) / "dataflow.systemd.yml").write_text(json.dumps(settings))
        (Path(PLACE) / "doubler.py").write_text(self.program)


@pytest.mark.warns("doubler", "Node sink", "Node source", "dora-flow.service: ")
@pytest.mark.parametrize(
    ("flow", "how"),
    [
        (Essential({"gpu": "b"}, FAILS), "exit code 3"),
        (Essential({"gpu": "b"}, watchdog="2s"), "hung, no WATCHDOG=1 for 2s"),
    ],
    ids=["fails", "hangs"],
)
def test_an_essential_node_there(flow: Essential, how: str, request: pytest.FixtureRequest) -> None:
    """The failure is the node's, not the loss of its machine."""
    with flow_on(flow, [*announced(request), *AGAIN]):
        flow.start("--grace-duration=2s")
        wait_for("the dataflow has failed", lambda: flow.cell.show("ActiveState") == "failed")
        why = flow.cell.doractl("why", NAME).stdout
    assert f"essential node doubler: {how}" in why
    assert "machine gpu:" not in why

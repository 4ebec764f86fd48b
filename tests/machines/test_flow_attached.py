"""`start --attach` of a dataflow over several machines prints the lines of all of them."""

import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.lab.pace import bound
from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.journals import LOST
from tests.machines.wires import cable
from tests.system.cells import wait_for


@pytest.fixture
def flow() -> Iterator[Flow]:
    """Its files are everywhere; the sink, which prints, is on c."""
    of_arm = (one.replace("gpu", "arm") for one in LOST)
    with flow_on(Flow({"gpu": "b", "arm": "c"}), (*LOST, *of_arm)) as flow:
        yield flow


def test_lines_of_a_machine_that_is_away_for_a_while(flow: Flow, tmp_path: Path) -> None:
    printed, complained = tmp_path / "printed", tmp_path / "complained"
    words = ["doractl", "start", f"{PLACE}/dataflow.yml", "--name", NAME, *flow.flags()]
    more = ["--attach", "--restart-policy=on-failure", "--grace-duration=2s"]

    def count(part: str) -> int:
        return sum(part in line for line in printed.read_text().splitlines())

    with (
        printed.open("w") as out,
        complained.open("w") as errors,
        subprocess.Popen([*words, *more], stdout=out, stderr=errors) as attached,
    ):
        wait_for("lines of both", lambda: count(" sent ") and count(" got "), 60)
        lines = [line for line in printed.read_text().splitlines() if " got " in line]
        assert all("sink" in line for line in lines)
        assert len(set(lines)) == len(lines), "no line is printed twice"
        life = flow.life()
        with cable("c", "mute"):
            wait_for("the head waits", lambda: "waiting for machine" in flow.status(), 15)
        flow.wait_again(life)
        before = count(" got ")
        wait_for("lines of c again", lambda: count(" got ") > before, 60)
        attached.send_signal(signal.SIGINT)
        attached.wait(bound(60))
    complaints = complained.read_text()
    assert complaints.count("the lines of machine arm are missing for now: ") <= 2
    assert "Traceback" not in complaints
    assert flow.cell.is_gone

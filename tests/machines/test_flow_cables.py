"""One dataflow over several machines, and what takes a machine or a cable from it.

After each: it runs again or says what it waits for, and no process is left where none should be.
"""

import time

import pytest

from tests.lab.pace import bound
from tests.machines.flows import GRACE, NAME, THREE, TWO, Flow
from tests.machines.journals import killed, lost
from tests.machines.wires import cable, power_cut, there
from tests.system.cells import run, wait_for


def nothing_on(machine: str) -> bool:
    """Whether no process of the dataflow is left on a machine."""
    return not there(machine, "pgrep", "-f", "'/opt/flow|dora daemon'").stdout


@lost
@killed
@pytest.mark.warns("Watchdog timeout (limit 25s)", "Killing process", "with result 'watchdog'")
@pytest.mark.parametrize("flow", [TWO], indirect=True)
def test_a_link_hangs(flow: Flow) -> None:
    """The head takes the machine for lost, and systemd ends the link."""
    life = flow.life()
    run("systemctl", "kill", "-s", "STOP", f"doralink-{NAME}:gpu.service")
    flow.wait_again(life)
    assert flow.cell.show("NRestarts") == "0"


def test_a_short_break_is_only_a_gap(flow: Flow) -> None:
    life = flow.life()
    with cable("b", "mute"):
        time.sleep(1.5)  # the length of the break is what this is about
    flow.wait_exchanging()
    assert flow.life() == life


@lost
@pytest.mark.parametrize(("flow", "how"), [(THREE, "off"), (TWO, "mute")], indirect=["flow"])
def test_a_cable_is_out(flow: Flow, how: str) -> None:
    """Both sides end within seconds, and it runs again soon after; no restart is counted."""
    life = flow.life()
    begun = time.monotonic()
    with cable("b", how):
        wait_for("the head knows", lambda: "waiting for machine" in flow.status(), 15)
        assert time.monotonic() - begun < bound(15)
        assert "gpu" in flow.status()
        refused = flow.cell.doractl("restart", NAME, check=False)
        assert refused.stderr.startswith("doractl: cannot reach machine gpu: ")
        assert f"doractl restart --force {NAME} restarts it anyway" in refused.stderr
    assert nothing_on("b") or flow.life() != life
    flow.wait_again(life)
    assert flow.cell.show("NRestarts") == "0"
    assert "Restarts:" not in flow.cell.doractl("why", NAME).stdout


@lost
@pytest.mark.parametrize("flow", [TWO], indirect=True)
def test_a_stop_while_a_machine_is_away(flow: Flow) -> None:
    with cable("b", "mute"):
        begun = time.monotonic()
        done = flow.cell.doractl("stop", NAME)
        taken = time.monotonic() - begun
        assert done.returncode == 0, done.stderr
        assert taken < bound(GRACE + 3)
    wait_for("b has ended its part", lambda: nothing_on("b"))


@lost
def test_a_machine_boots_again(flow: Flow) -> None:
    life = flow.life()
    with power_cut("b"):
        wait_for("the head knows", lambda: "waiting for machine" in flow.status(), 15)
        assert flow.row()["status"] == "Waiting"
    flow.wait_again(life)
    assert flow.cell.show("NRestarts") == "0"


@lost
@pytest.mark.parametrize("flow", [TWO], indirect=True)
def test_a_machine_that_shuts_down_has_not_stopped_it(flow: Flow) -> None:
    """systemd stops everything there; that is no request to stop this dataflow."""
    life = flow.life()
    there("b", "systemctl", "poweroff")
    wait_for("the head waits", lambda: "waiting for machine" in flow.status(), 15)
    with power_cut("b"):  # the lab needs that to switch it on again
        pass
    flow.wait_again(life)


@lost
@pytest.mark.warns("flow: Dataflow flow failed: it was stopped on machine gpu by SIGTERM")
def test_somebody_stops_a_member(flow: Flow) -> None:
    """That ends the whole, and is no failure to restart."""
    assert there("b", "systemctl", "stop", f"dora-{NAME}").returncode == 0
    wait_for("the head has ended", lambda: flow.cell.is_gone)
    why = flow.cell.doractl("why", NAME).stdout
    assert "gpu" in why
    assert "stopped" in why
    wait_for("nothing is left", lambda: not flow.left())

"""One dataflow over two machines, and what can happen to it. Whatever it is, it comes back."""

import time
from collections.abc import Callable, Iterator

import pytest

from tests.lab.pace import bound
from tests.machines.flows import GRACE, Flow, left_on, lifetime
from tests.machines.wires import cable, power_cut, there
from tests.system.cells import run, wait_for

LEASE = 7
KNOWN = 10
"""Seconds within which both machines know that the other one is gone."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Flow]:
    yield from lifetime(Flow("faulty"))


@pytest.fixture
def flow(shared: Flow) -> Flow:
    """The dataflow runs."""
    if shared.is_gone:
        done = shared.begin()
        assert done.returncode == 0, done.stderr
    shared.wait_running()
    return shared


def kill_here(flow: Flow, what: str) -> None:
    run("kill", "-KILL", str(flow.supervisor_pid(what)))


def kill_link(flow: Flow) -> None:
    run("systemctl", "kill", "--signal=KILL", f"doralink-{flow.name}:gpu.service")


def kill_session(flow: Flow) -> None:
    """The sshd of the link on b: the parent of what carries the lines there."""
    del flow
    script = "kill -KILL $(ps -o ppid= -p $(pgrep -of '[d]ora_systemd.link.relay'))"
    assert there("b", "sh", "-c", f"'{script}'").returncode == 0


FAULTS: dict[str, tuple[Callable[[Flow], None], str]] = {
    "daemon on b": (
        lambda flow: flow.kill_on_b("dora daemon"),
        "machine gpu: the dora daemon is gone (signal SIGKILL)",
    ),
    "runner on b": (lambda flow: flow.kill_on_b("dora_systemd.runner"), "machine gpu: "),
    "daemon on a": (
        lambda flow: kill_here(flow, "daemon"),
        "the dora daemon is gone (signal SIGKILL)",
    ),
    "coordinator": (
        lambda flow: kill_here(flow, "coordinator"),
        "the dora coordinator is gone (signal SIGKILL)",
    ),
    "runner on a": (lambda flow: kill_here(flow, "runner"), ""),
    "link": (kill_link, "machine gpu: "),
    "session on b": (kill_session, "machine gpu: "),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_lost_part_is_a_lost_run_and_all_comes_back(flow: Flow, fault: str) -> None:
    kill, reason = FAULTS[fault]
    before, restarts = flow.life, int(flow.show("NRestarts"))
    kill(flow)
    wait_for("another life", lambda: flow.show("InvocationID") != before[0])
    flow.wait_running()
    assert flow.life[1] != before[1]
    assert int(flow.show("NRestarts")) == restarts + 1
    assert flow.reasons()[-1].startswith(reason)


def test_a_node_on_b_is_restarted_there(flow: Flow) -> None:
    before = flow.life
    flow.kill_on_b("flow/mid.py")
    wait_for("the head sees it", lambda: flow.status.nodes["mid"].restarts == 1)
    flow.wait_running()
    assert flow.life == before


def test_a_gap_is_no_loss(flow: Flow) -> None:
    before = flow.life
    with cable("b", "off"):
        time.sleep(3)  # that is the fault
    flow.wait_running()
    assert flow.life == before


def test_a_pulled_cable(flow: Flow) -> None:
    """Both ends let go, the head waits without a restart, and all runs when it is back."""
    restarts = int(flow.show("NRestarts"))
    with cable("b", "mute"):
        begun = time.monotonic()
        wait_for("the head knows", lambda: "machine gpu" in flow.show("StatusText"))
        assert time.monotonic() - begun < bound(KNOWN)
        wait_for("it waits", flow.waits)
        assert flow.show("ActiveState") == "activating"
        waits = time.monotonic() + LEASE
        wait_for("it still waits", lambda: time.monotonic() > waits)
        assert int(flow.show("NRestarts")) == restarts + 1
    flow.wait_running()
    assert int(flow.show("NRestarts")) == restarts + 1
    ended = there("b", "journalctl", "-o", "cat", "-u", flow.unit, "DORA_EVENT=machine-lost").stdout
    assert "Machine head of dataflow faulty is lost" in ended


def test_a_stop_does_not_wait_for_a_machine_that_is_away(flow: Flow) -> None:
    with cable("b", "mute"):
        begun = time.monotonic()
        flow.doractl("stop", flow.name)
        assert time.monotonic() - begun < bound(GRACE + 3)
        assert not left_on("a")
    wait_for("b lets go by itself", lambda: not left_on("b"))


def test_the_other_machine_boots_again(flow: Flow) -> None:
    restarts = int(flow.show("NRestarts"))
    with power_cut("b"):
        wait_for("it waits", flow.waits)
    flow.wait_running()
    assert int(flow.show("NRestarts")) == restarts + 1


def test_who_stops_a_member_stops_all(flow: Flow) -> None:
    assert there("b", "systemctl", "stop", flow.unit).returncode == 0
    wait_for("the head ends", lambda: flow.show("ActiveState") == "failed")
    assert flow.reasons()[-1] == "it was stopped on machine gpu by SIGTERM"
    wait_for("nothing is left", lambda: not left_on("a") and not left_on("b"))

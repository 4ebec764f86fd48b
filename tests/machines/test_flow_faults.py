"""One dataflow over several machines, and what takes a machine, a process or a cable from it.

After each: it runs again or says what it waits for, and no process is left where none should be.
"""

import time
from collections.abc import Iterator

import pytest

from tests.lab.pace import bound
from tests.machines.flows import NAME, Flow, flow_on
from tests.machines.journals import BUSY, LOST, announced
from tests.machines.wires import cable, power_cut, there
from tests.system.cells import run, wait_for

TWO = {"gpu": "b"}
THREE = {"gpu": "b", "arm": "c"}
GRACE = 2
lost = pytest.mark.warns(*LOST)
killed = pytest.mark.warns(
    "Main process exited, code=killed, status=9/KILL", "Failed with result 'signal'"
)


@pytest.fixture(params=[TWO, THREE], ids=["two", "three"])
def flow(request: pytest.FixtureRequest) -> Iterator[Flow]:
    """A dataflow that runs, and is started again whatever ends it."""
    policy = ("--restart-policy=on-failure", "--max-restarts=50", f"--grace-duration={GRACE}s")
    with flow_on(Flow(request.param), [*announced(request), *BUSY]) as flow:
        flow.start(*policy)
        flow.wait_exchanging()
        yield flow


def nothing_on(machine: str) -> bool:
    """Whether no process of the dataflow is left on a machine."""
    return not there(machine, "pgrep", "-f", "'/opt/flow|dora daemon'").stdout


@lost
@killed
@pytest.mark.warns("SIGKILL", "b: systemd: dora-flow")
@pytest.mark.warns("flow/daemon: dora_daemon: daemon disconnected from coordinator: ")
@pytest.mark.parametrize(
    ("machine", "pattern"),
    [
        ("a", "dora_systemd.runner"),
        ("a", "dora coordinator"),
        ("a", "dora daemon"),
        ("b", "dora_systemd.runner"),
        ("b", "dora daemon"),
    ],
)
def test_a_process_is_killed(flow: Flow, machine: str, pattern: str) -> None:
    life = flow.life()
    flow.kill(machine, pattern)
    flow.wait_again(life)


@lost
@killed
@pytest.mark.warns("SIGKILL", "b: systemd: dora-flow", "no heartbeat message from machine `gpu-")
def test_a_daemon_hangs(flow: Flow) -> None:
    """The daemon of a member, whose head is well: dora itself would let it go after 30 s."""
    life = flow.life()
    flow.kill("b", "dora daemon", "STOP")
    flow.wait_again(life)


@pytest.mark.warns("Node doubler crashed: ", "Node doubler is being restarted", "Signal(9)")
def test_a_node_is_killed(flow: Flow) -> None:
    """dora restarts it there; the others run on."""
    life = flow.life()
    flow.kill("b", "/opt/flow/doubler.py")
    wait_for("it is restarted", lambda: flow.table()["doubler"]["restarts"] == 1)
    flow.wait_exchanging()
    assert flow.life() == life


@pytest.mark.warns("failed to receive reply from daemon", "ExitCode(3) node_id=doubler")
def test_what_somebody_asks_for_is_no_crash(flow: Flow) -> None:
    """On no machine, however the node ends; and its restarts stay."""
    life = flow.life()
    there("b", "sh", "-c", "'echo \"raise SystemExit(3)\" >>/opt/flow/doubler.py'")
    for _ in range(3):
        flow.cell.doractl("node", "restart", NAME, "doubler")
        wait_for("it runs", lambda: flow.table()["doubler"]["state"] == "running")
        flow.wait_exchanging()
    flow.cell.doractl("node", "restart", NAME, "sink")  # nobody reads it
    wait_for("it runs", lambda: flow.table()["sink"]["state"] == "running")
    flow.wait_exchanging()
    assert flow.life() == life
    assert flow.table()["doubler"]["restarts"] == 0
    begin = there("b", "systemctl", "show", "-P", "InvocationID", f"dora-{NAME}").stdout.strip()
    words = ("journalctl", "-q", "-o", "cat", "-t", f"{NAME}/doubler")
    events = there("b", *words, f"_SYSTEMD_INVOCATION_ID={begin}").stdout
    assert events.count("Node doubler: restart requested by root (doractl node restart)") == 3
    assert "crashed" not in events
    assert "Node doubler exited: exit code 3" in events
    if "arm" in flow.members:
        flow.cell.doractl("node", "stop", NAME, "sink")
        assert flow.table()["sink"]["stopped_by"] == "root (doractl node stop)"
        again = flow.cell.doractl("node", "restart", NAME, "sink", check=False)
        assert f"doractl restart {NAME} starts the whole dataflow" in again.stderr


@lost
@killed
@pytest.mark.parametrize("what", ["link", "ssh", "relay", "sshd"])
def test_the_link_is_killed(flow: Flow, what: str) -> None:
    life = flow.life()
    unit = f"doralink-{NAME}:gpu.service"
    if what == "link":
        run("systemctl", "kill", "-s", "KILL", "--kill-whom=main", unit)
    elif what == "ssh":
        run("pkill", "-9", "-f", "ssh -T .* b exec")
    elif what == "relay":
        assert there("b", "pkill -9 -f '[d]ora_systemd.link.relay'").returncode == 0
    else:
        relay = "pgrep -f '[d]ora_systemd.link.relay'"
        assert there("b", f"kill -9 $(ps -o ppid= $({relay}))").returncode == 0
    flow.wait_again(life)


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
@pytest.mark.parametrize("how", ["off", "mute"])
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

"""One dataflow over several machines, and what takes a process or a link from it.

After each: it runs again or says what it waits for, and no process is left where none should be.
"""

import pytest

from tests.machines.flows import NAME, THREE, TWO, Flow
from tests.machines.journals import killed, lost
from tests.machines.wires import there
from tests.system.cells import run, wait_for


@lost
@killed
@pytest.mark.warns("SIGKILL", "b: systemd: dora-flow")
@pytest.mark.parametrize(
    ("flow", "machine", "pattern"),
    [
        (TWO, "a", "dora_systemd.runner"),
        (THREE, "a", "dora coordinator"),
        (TWO, "a", "dora daemon"),
        (THREE, "b", "dora_systemd.runner"),
        (TWO, "b", "dora daemon"),
    ],
    indirect=["flow"],
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
@pytest.mark.parametrize("flow", [TWO], indirect=True)
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
    flow.cell.doractl("node", "stop", NAME, "sink")
    assert flow.table()["sink"]["stopped_by"] == "root (doractl node stop)"
    again = flow.cell.doractl("node", "restart", NAME, "sink", check=False)
    assert f"doractl restart {NAME} starts the whole dataflow" in again.stderr


@lost
@killed
@pytest.mark.parametrize(
    ("flow", "what"),
    [(TWO, "link"), (THREE, "ssh"), (TWO, "relay"), (THREE, "sshd")],
    indirect=["flow"],
)
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

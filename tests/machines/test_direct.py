"""One dataflow over several machines with `link: direct`: its messages go without ssh."""

from collections.abc import Iterator

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.direct import ADDRESSES, DirectFlow
from tests.machines.flows import NAME, THREE, TWO, flow_on
from tests.machines.journals import LOST, announced
from tests.machines.wires import cable, there
from tests.system.cells import run, wait_for

SSHD = {"0.0.0.0:22", "[::]:22"}


@pytest.fixture(params=[TWO], ids=["two"])
def flow(request: pytest.FixtureRequest) -> Iterator[DirectFlow]:
    """A dataflow whose files are everywhere."""
    with flow_on(DirectFlow(request.param), announced(request)) as flow:
        yield flow


def listeners(machine: str) -> dict[str, str]:
    """Who listens for others: by address with its port, the name of the program."""
    lines = there(machine, "ss", "-Hltnp").stdout.splitlines()
    found = {line.split()[3]: line.split('"')[1] for line in lines}
    return {one: name for one, name in found.items() if not one.startswith("127.0.0.1:")}


def connected(machine: str) -> set[str]:
    """The addresses of other machines that programs of the dataflow are connected with."""
    lines = there(machine, "ss", "-Htnp", "state", "established").stdout.splitlines()
    ends = {line.split()[3] for line in lines if "python" in line or '"dora"' in line}
    return {one.rpartition(":")[0] for one in ends} - {"127.0.0.1", ADDRESSES[machine]}


@pytest.mark.parametrize("flow", [TWO, THREE], ids=["two", "three"], indirect=True)
def test_only_zenoh_listens_and_only_on_the_addresses(flow: DirectFlow) -> None:
    started = flow.start()
    assert started.returncode == 0, started.stderr
    flow.wait_exchanging()
    assert {one["state"] for one in flow.table().values()} == {"running"}
    for machine in flow.machines:
        found = listeners(machine)
        assert found.keys() >= SSHD
        own = {one: name for one, name in found.items() if one not in SSHD}
        assert {one.rpartition(":")[0] for one in own} == {ADDRESSES[machine]}, found
        assert "dora" in own.values()
        assert connected(machine)
        allowed = there(machine, "systemctl", "show", "-P", "IPAddressAllow", f"dora-{NAME}")
        wanted = {f"{ADDRESSES[one]}/32" for one in flow.machines}
        assert wanted <= set(allowed.stdout.split())
    forwarded = there("b", "ss", "-Hltnp").stdout
    assert sum("sshd" in line and "127.0.0.1" in line for line in forwarded.splitlines()) == 1
    assert flow.cell.doractl("stop", NAME).returncode == 0
    assert not flow.left()
    assert all(listeners(machine).keys() == SSHD for machine in flow.machines)


def test_nodes_meet_without_a_daemon_between(flow: DirectFlow) -> None:
    """The doubler on b is connected with a node on a, whose port no daemon has."""
    flow.start()
    flow.wait_exchanging()
    doubler = flow.pid("b", "/opt/flow/doubler.py")
    lines = there("b", "ss", "-Htnp", "state", "established").stdout.splitlines()
    peers = [line.split()[3] for line in lines if f"pid={doubler}," in line]
    theirs = listeners("a")
    assert "python" in {theirs.get(one) for one in peers}, (peers, theirs)


@pytest.mark.warns(*LOST)
def test_a_cable_is_out(flow: DirectFlow) -> None:
    """Both sides end by the lease, as with ssh; it runs again, and no restart is counted."""
    flow.start("--restart-policy=on-failure", "--max-restarts=3", "--grace-duration=2s")
    life = flow.life()
    with cable("b", "mute"):
        wait_for("the head knows", lambda: "waiting for machine" in flow.status(), 15)
    flow.wait_again(life)


class TestRefusals:
    """One line, and nothing is left anywhere."""

    def test_an_address_that_cannot_be_one_of_that_machine(self, flow: DirectFlow) -> None:
        flow.write_settings(address="127.0.0.1")
        flow.refused("machines.gpu", "address '127.0.0.1'", code=ExitCode.BAD_INPUT)
        flow.write_settings(address=ADDRESSES["a"])
        flow.refused("gpu have the same address", code=ExitCode.BAD_INPUT)
        flow.write_settings(head_address="10.77.0.9")
        flow.refused("gpu from 10.77.0.9", code=ExitCode.BAD_INPUT)

    @pytest.mark.warns("flow failed: ", "Failed with result", "Failed to start", "lost: ")
    def test_an_address_of_another_machine(self, flow: DirectFlow) -> None:
        flow.write_settings(address=ADDRESSES["c"])
        words = ("machine gpu", f"has no address {ADDRESSES['c']}")
        flow.refused(*words, code=ExitCode.BAD_INPUT)


def test_the_user_may_let_nodes_reach_more(flow: DirectFlow) -> None:
    shown = flow.start("--property=IPAddressAllow=192.0.2.0/24", "--dry-run").stdout
    lines = [line for line in shown.splitlines() if line.startswith("IPAddress")]
    assert "192.0.2.0/24" in " ".join(lines)
    assert ADDRESSES["b"] in " ".join(lines)
    assert "--address=10.77.0.2" in shown
    assert not run("systemctl", "list-units", "--plain", "--no-legend", "dora*flow*").stdout

"""An enabled dataflow over two machines that boot again: its head is on b, its member on c."""

import json
import subprocess
from collections.abc import Iterator
from functools import partial

import pytest

from tests.machines.flows import NAME, PLACE, Flow
from tests.machines.journals import LOST, quiet_journals
from tests.machines.wires import power_cut, there
from tests.system.cells import run, wait_for

HEAD, MEMBER = "b", "c"
KEYS = ("id_ed25519", "id_ed25519.pub", "known_hosts")
PROCESSES = {
    HEAD: ("dora_systemd.runner", "dora coordinator", "dora daemon", "source.py", "sink.py"),
    MEMBER: ("dora_systemd.runner", "dora daemon", "doubler.py"),
}


def head(*words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """doractl on the head."""
    done = there(HEAD, "doractl", *words)
    assert not check or done.returncode == 0, done.stderr
    return done


@pytest.fixture
def flow() -> Iterator[Flow]:
    """It runs, it is enabled, and root of b can log in on c."""
    flow = Flow({"gpu": MEMBER})
    flow.bring()
    run("sed", "-i", f"s/machine: a}}/machine: {HEAD}}}/", f"{PLACE}/dataflow.yml")
    for machine in PROCESSES:
        run("scp", "-q", "-r", PLACE, f"root@{machine}:/opt")
    run("scp", "-q", *(f"/root/.ssh/{key}" for key in KEYS), f"root@{HEAD}:/root/.ssh/")
    with quiet_journals(LOST):
        more = ("--restart-policy=on-failure", "--enable", "--grace-duration=2s")
        head("start", f"{PLACE}/dataflow.yml", "--name", NAME, *flow.flags(), *more)
        try:
            yield flow
        finally:
            head("disable", NAME, check=False)
            head("stop", NAME, check=False)
        for machine in PROCESSES:
            wait_for(f"nothing is left on {machine}", partial(is_clear, machine))
    there(HEAD, "rm", *(f"/root/.ssh/{key}" for key in KEYS))


def processes(machine: str) -> list[str]:
    """The command lines of dora's processes and of the nodes, wherever they are."""
    found = there(machine, "pgrep -af '[d]ora_systemd|[d]ora (daemon|coordinator)|[/]opt/flow'")
    return found.stdout.splitlines()


def is_clear(machine: str) -> bool:
    return not processes(machine)


def is_away(machine: str) -> bool:
    return there(machine, "true").returncode != 0


def heard() -> str:
    return there(HEAD, f"journalctl -q -n 1 -o short-unix -t {NAME}/sink").stdout


def runs() -> bool:
    """A node may receive a message before the head knows that all nodes are open."""
    row = json.loads(head("list", NAME, "-o", "json").stdout)
    return {node["state"] for node in row["nodes"]} == {"running"}


def runs_once() -> None:
    """Return when messages flow between the machines; each process is there once, in its unit."""
    before = heard()
    wait_for("the sink hears more", lambda: heard() not in ("", before), 60)
    wait_for("all nodes run", runs, 60)
    flow = Flow({"gpu": MEMBER})
    for machine, patterns in PROCESSES.items():
        for pattern in patterns:
            found = [line.split()[0] for line in processes(machine) if pattern in line]
            assert found == [flow.pid(machine, pattern)]


@pytest.mark.parametrize("how", ["cut", "shutdown"])
def test_the_machines_boot_again(flow: Flow, how: str) -> None:
    """Nobody does anything: systemd of the head starts all of it."""
    del flow
    runs_once()
    for machine in (HEAD, MEMBER):
        if how == "shutdown":
            there(machine, "systemctl", "poweroff")
            wait_for("its sshd is gone", partial(is_away, machine))
        with power_cut(machine):
            pass
        runs_once()

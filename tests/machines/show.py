"""Prints docs/machines.md: what was typed and seen on the machines of the lab, and times of faults.

    LAB=machines tests/lab/lab run -- python -m tests.machines.show [faults] >docs/machines.md

The parts of the text are here; everything in a block was printed by doractl just then.
"""

import json
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.logs.query import journal_timestamp
from dora_systemd.values import SECOND
from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.wires import cable, power_cut, there
from tests.system.cells import run, wait_for

_POLICY = ("--restart-policy=on-failure", "--max-restarts=50", "--grace-duration=2s")
_DELAYS = ("--restart-delay=1s", "--max-restart-delay=1s")
_HEADING = """# Several machines, as seen

Written by `python -m tests.machines.show` in the lab `LAB=machines`: three containers with Debian
13, systemd, dora and sshd, named a, b and c, on one network. The dataflow is that of the tests:
`source` runs on a, `doubler` on b, and `sink` on a or c. See dora-systemd-machines(7).

## A life, and a pulled cable

"""
_TABLE = """
## Faults

The restart policy is `on-failure` with a delay of 1 s, the grace duration 2 s. *knows*: seconds
from the fault to the event in the journal of the head, and of b. *back*: seconds from the end of
the fault until the sink has got a message of the next run. All machines share {count} processors,
and what else ran there at the time made {load} processes wait for one: an idle machine is faster.

| fault | 2 machines: head knows | b knows | back | 3 machines: head knows | b knows | back |
|---|---|---|---|---|---|---|
"""


def main() -> None:
    """Print all of it, or the table alone."""
    if sys.argv[1:] != ["faults"]:
        print(_HEADING + "```")
        _show_life()
        print("```")
    load = Path("/proc/loadavg").read_text().split()[0]
    count = run("nproc").stdout.strip()
    print(_TABLE.format(count=count, load=load), end="", flush=True)
    two, three = (_times({"gpu": "b", **more}) for more in ({}, {"arm": "c"}))
    for fault in FAULTS:
        cells = [*two[fault.name], *three[fault.name]]
        print(f"| {fault.name} | {' | '.join(cells)} |", flush=True)


def _show_life() -> None:
    flow = Flow({"gpu": "b"})
    flow.bring()
    _type("doractl machine add root@b --name gpu")
    _type(f"doractl start {PLACE}/dataflow.yml --name {NAME} --restart-policy on-failure")
    flow.wait_exchanging()
    _wait_measured(flow)
    _type(f"doractl list {NAME}")
    _type(f"doractl logs {NAME} -n 3")
    _type(f"doractl list {NAME}", on="b")
    with cable("b", "mute"):
        _say("the cable of b is out")
        wait_for("the head knows", lambda: "waiting for machine" in flow.status())
        _type("doractl list")
        _type(f"doractl why {NAME}")
    _say("the cable is in again")
    flow.wait_exchanging()
    _wait_measured(flow)  # what the head knows of b is up to a second old
    _type("doractl list")
    _type(f"doractl why {NAME}")
    _type(f"doractl why {NAME}", on="b")
    _type(f"doractl stop {NAME}")
    _type("doractl machine remove gpu")
    assert not flow.left()


def _wait_measured(flow: Flow) -> None:
    wait_for("b has told", lambda: flow.table()["doubler"]["memory_bytes"])


def _type(command: str, on: str = "a") -> None:
    """Run a command, and print it as it was typed, with what came."""
    done = run("sh", "-c", f"{command} 2>&1", check=False) if on == "a" else there(on, command)
    print(f"{on}$ {command}\n{done.stdout}{done.stderr if on != 'a' else ''}", flush=True)


def _say(text: str) -> None:
    print(f"# {text}\n", flush=True)


class Fault(NamedTuple):
    """One row. does: the fault, as long as its block lasts, in which the head gets to know it."""

    name: str
    does: Callable[[Flow], Iterator[None]]


def _killing(machine: str, pattern: str) -> Callable[[Flow], Iterator[None]]:
    def does(flow: Flow) -> Iterator[None]:
        flow.kill(machine, pattern)
        yield

    return does


def _typing(machine: str, command: str) -> Callable[[Flow], Iterator[None]]:
    def does(_: Flow) -> Iterator[None]:
        there(machine, command)
        yield

    return does


def _cable(_: Flow) -> Iterator[None]:
    with cable("b", "mute"):
        yield


def _power(_: Flow) -> Iterator[None]:
    with power_cut("b"):
        yield


_RELAY = "$(pgrep -f '[d]ora_systemd.link.relay')"
FAULTS = (
    Fault("runner of a killed", _killing("a", "dora_systemd.runner")),
    Fault("coordinator killed", _killing("a", "dora coordinator")),
    Fault("daemon of a killed", _killing("a", "dora daemon")),
    Fault("runner of b killed", _killing("b", "dora_systemd.runner")),
    Fault("daemon of b killed", _killing("b", "dora daemon")),
    Fault("the link's ssh killed", _typing("a", "pkill -9 -f 'ssh -T .* b exec'")),
    Fault("sshd session on b killed", _typing("b", f"kill -9 $(ps -o ppid= {_RELAY})")),
    Fault("cable of b out", _cable),
    Fault("power of b cut", _power),
)


def _times(members: dict[str, str]) -> dict[str, list[str]]:
    """The cells of each fault."""
    with flow_on(Flow(members), ("",)) as flow:  # its warnings are what this is about
        flow.start(*_POLICY, *_DELAYS)
        return {fault.name: _time(flow, fault) for fault in FAULTS}


def _time(flow: Flow, fault: Fault) -> list[str]:
    flow.wait_exchanging()
    life, begun = flow.life(), time.time()
    with contextmanager(fault.does)(flow):
        wait_for("the head knows", lambda: _first_event("a", begun))
        wait_for("the head has ended the run", lambda: flow.life() != life or not flow.is_running())
        over = time.time()
    over = over if fault.does in (_cable, _power) else begun
    flow.wait_again(life)
    back = time.time()
    times = [_first_event("a", begun) - begun, _first_event("b", begun) - begun, back - over]
    print(f"{fault.name}: {times}", file=sys.stderr, flush=True)
    return [f"{one:.1f}" if one > 0 else "-" for one in times]


def _first_event(machine: str, since: float) -> float:
    """When the journal of a machine first tells of a loss or a failure; 0.0 if it does not."""
    events = ("machine-lost", "daemon-lost", "coordinator-lost", "dataflow-failed")
    matches = " ".join(f"DORA_EVENT={one}" for one in events)
    begin = shlex.quote(journal_timestamp(round(since * SECOND)))
    words = f"journalctl -q -o json --output-fields=DORA_EVENT --since={begin} {matches}"
    lines = there(machine, words).stdout.splitlines()
    return int(json.loads(lines[0])["__REALTIME_TIMESTAMP"]) / SECOND if lines else 0.0


if __name__ == "__main__":
    main()

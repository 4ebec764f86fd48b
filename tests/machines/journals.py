"""The journals of all machines: what in them nobody expects."""

import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest

from tests.machines.wires import OTHERS, there
from tests.system.cells import journalctl
from tests.system.complaints import Journalctl, complaints, end_of_journal

LOST = (
    "flow: Machine gpu of dataflow flow is lost: ",
    "flow: Dataflow flow failed: machine gpu: ",
    "systemd: dora-flow.service: Failed with result 'exit-code'",
    "flow: Machine head of dataflow flow is lost: ",
)
"""What all say when the head has lost a member."""
lost = pytest.mark.warns(*LOST)
killed = pytest.mark.warns(
    "Main process exited, code=killed, status=9/KILL", "Failed with result 'signal'"
)
AGAIN = ("failed to connect to dora-coordinator", "Could not connect to WS at")
"""Of a daemon that is ended while it tries to reach a coordinator that has gone."""
BUSY = (
    *("node exited with error: Signal(15)", "State 'stop-post' timed out"),
    *("failed to send log message to dora-coordinator", "WS send channel closed"),
    "Received Data for unknown expr_id",
    *("failed to send heartbeat message to daemon", "daemons that failed watchdog"),
    "has not stopped in its time",
)
"""Of a machine that gives a node too little time within the grace, or systemd's last command, or
whose daemon still has something to report when the coordinator of the head has ended, or receives a
message of a node that was killed before it knows the name of the output; or whose coordinator ends
later than the daemon of another machine."""


def _journalctl(machine: str, *words: str) -> str:
    return there(machine, shlex.join(("journalctl", *words))).stdout


@contextmanager
def quiet_journals(expected: Iterable[str] = ()) -> Iterator[None]:
    """No machine's journal has an unexpected warning of our units from meanwhile.

    What a BUSY machine says is expected of each.
    """
    journals: dict[str, Journalctl] = {"a": journalctl}
    journals |= {one: partial(_journalctl, one) for one in OTHERS}
    begin = {machine: end_of_journal(ask) for machine, ask in journals.items()}
    assert all(begin.values()), begin
    yield
    known = [*expected, *BUSY]
    told = [
        f"{machine}: {line}"
        for machine, ask in journals.items()
        for line in complaints(begin[machine], [], ask)
    ]
    told = [one for one in told if not any(words in one for words in known)]
    assert not told, "unexpected warnings:\n" + "\n".join(told)


def announced(request: pytest.FixtureRequest) -> list[str]:
    """The warnings that a test expects, by its mark `warns`."""
    return [one for mark in request.node.iter_markers("warns") for one in mark.args]

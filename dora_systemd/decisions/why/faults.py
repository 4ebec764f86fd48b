"""What fails the trial of a release: the events of its nodes and of its cell. Pure."""

from collections.abc import Iterable
from typing import NamedTuple

from dora_systemd.decisions.logs.events import EVENTS
from dora_systemd.decisions.why.lives import Happening

FAULTS = (
    *("node-crashed", "node-oom", "node-hung", "node-watchdog", "node-silent", "node-waiting"),
    *("node-restarted", "dataflow-oom"),
    *("daemon-lost", "coordinator-lost", "dataflow-failed"),
)
ENDS = ("dataflow-finished", "dataflow-stopped")
FAULT_IDS = tuple(EVENTS[name].message_id for name in (*FAULTS, *ENDS))
"""The MESSAGE_IDs that a trial looks for."""
_HOW = {"node-watchdog": "hung, ", "node-waiting": "waits for "}
"""What `why` and `list` say before the reason, where that is not the name of the event."""


class Fault(NamedTuple):
    """Why a release has failed its trial. node: the first that failed, or "".

    is_stop: somebody has stopped the dataflow, so nothing is started in its place.
    """

    reason: str
    node: str = ""
    is_stop: bool = False


def find_fault(happenings: Iterable[Happening], since_us: int, before: str) -> Fault | None:
    """The first fault since then, None if there is none.

    since_us: CLOCK_REALTIME µs. before: systemd's invocation id of what ran before the trial, which
    may still write about its own end.
    """
    own = [one for one in happenings if one.at_us >= since_us and one.invocation != before]
    faults = sorted((one for one in own if one.name in FAULTS), key=lambda one: one.at_us)
    return _fault(faults[0]) if faults else None


def is_finished(happenings: Iterable[Happening], since_us: int) -> bool:
    """Whether all nodes have ended by themselves since then, and nobody has stopped them."""
    ends = [one for one in happenings if one.name in ENDS and one.at_us >= since_us]
    return bool(ends) and max(ends, key=lambda one: one.at_us).name == "dataflow-finished"


def _how(one: Happening) -> str:
    reason, word = one.detail("reason"), one.name.replace("-", " ").removeprefix("node ")
    if not reason:
        return word
    return _HOW.get(one.name, f"{word}, ") + reason


def _fault(one: Happening) -> Fault:
    if one.node:
        how = one.detail("exit") or _how(one)
        return Fault(f"node {one.node}: {how}", one.node)
    first = one.detail("nodes").partition(" ")[0]
    return Fault(one.detail("reason") or one.text or one.name, first)

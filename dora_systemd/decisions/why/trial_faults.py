"""What fails the trial of a release: the events of its nodes and of its cell. Pure."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from dora_systemd.decisions.logs.journal_events import CLEAN_ENDS, EVENTS
from dora_systemd.decisions.why.lives import Happening

WAITING = "node-waiting"
FAULTS = (
    *("node-crashed", "node-ended", "node-oom", "node-hung", "node-watchdog", "node-silent"),
    *(WAITING, "node-restarted", "dataflow-oom"),
    *("daemon-lost", "coordinator-lost", "dataflow-failed"),
)
FAULT_IDS = tuple(EVENTS[name].message_id for name in (*FAULTS, *CLEAN_ENDS))
"""The MESSAGE_IDs that a trial searches."""
_HOW = {"node-watchdog": "hung, ", WAITING: "waits for "}
"""The text that `why` and `list` show before the reason, instead of the name of the event."""


class Fault(NamedTuple):
    """The fault for which a release has failed its trial."""

    reason: str
    node: str = ""  # the first that failed, or ""
    is_stop: bool = False  # the dataflow was stopped by a request, so nothing is started instead
    is_outside: bool = False  # the trial could not continue for a reason outside the release
    invocation: str = ""  # of systemd, the life in which it was
    lines: tuple[str, ...] = ()  # the last ones of the node, or of all nodes, oldest first

    @property
    def is_verdict(self) -> bool:
        """Whether the fault proves that the release is bad."""
        return not (self.is_stop or self.is_outside)


def find_fault(
    happenings: Sequence[Happening], before: str, may_wait: bool = False
) -> Fault | None:
    """The first fault of a trial, None if there is none.

    happenings: of the trial, newest first. before: systemd's invocation id of what ran before,
    which may still write about its own end. may_wait: a node that waits for what it needs is none.
    """
    own = (one for one in reversed(happenings) if one.invocation != before)
    faults = [one for one in FAULTS if not (may_wait and one == WAITING)]
    first = next((one for one in own if one.name in faults), None)
    return _fault(first) if first else None


def is_finished(happenings: Iterable[Happening]) -> bool:
    """Return whether all nodes have ended by themselves, without a request to stop.

    happenings: newest first.
    """
    last = next((one for one in happenings if one.name in CLEAN_ENDS), None)
    return last is not None and last.name == "dataflow-finished"


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

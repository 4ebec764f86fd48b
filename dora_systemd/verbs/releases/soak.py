"""The gate of a release: it starts, and then runs for a while without a fault.

With Restart=always a bad version never becomes "failed", and dora restarts nodes by itself. So the
gate reads the journal, too, where every crash and restart of a node is an event.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import takewhile
from typing import Any

from dora_systemd.adapters.bus.manager import DOWN, ON_THE_WAY, SETTLED, Manager, queued_job
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import Owed, owes_of
from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.life.kills import Kills
from dora_systemd.decisions.logs.query import kill_matches, scope_matches
from dora_systemd.decisions.releases.progress import Step, soaking, starting, stopping
from dora_systemd.decisions.why.last_lines import Word, choose_last, shown_last
from dora_systemd.decisions.why.lives import Happening, parse_happening
from dora_systemd.decisions.why.trial_faults import (
    FAULT_IDS,
    WAITING,
    Fault,
    find_fault,
    is_finished,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND, format_duration
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.facts.reading import read_heard
from dora_systemd.verbs.facts.reason import failure_reason, runners_refusal

Tell = Callable[[Step], None]
START_LIMIT = 120 * SECOND
"""µs for all nodes to become ready, unless the dataflow's own start_timeout is longer."""
LATE = "late"
LINES = 10
"""Maximum number of last lines of the node that failed."""
_STEP_SECONDS = 0.2
_LOOK_SECONDS = 1.0
_MOST_RECORDS = 200
_MICROSECOND_NS = 1000
_STOPPED = Fault("it was stopped", is_stop=True)


def settle(
    manager: Manager,
    unit: str,
    limit: int,
    tell: Callable[[str, str], None],
    is_over: Callable[[], bool] = bool,
) -> str:
    """Wait until a unit with a start job is up or down; return its ActiveState, or LATE.

    A unit that systemd is about to restart has failed. limit: µs, from the end of the stop of what
    ran before: TimeoutStopSec= of the unit bounds that stop. `tell`: gets the ActiveState and the
    status text of the unit at each check. is_over: whether to wait no longer. Raises
    DoraSystemdError.
    """
    deadline = time.monotonic() + limit / SECOND
    while True:
        facts = manager.read(unit, ["ActiveState", "SubState", "Job", "StatusText"])
        active, is_queued = str(facts["ActiveState"]), bool(queued_job(facts))
        if not is_queued and str(facts["SubState"]).startswith("auto-restart"):
            return "failed"
        if not is_queued and active not in ON_THE_WAY:
            return active
        if active == "deactivating":
            deadline = time.monotonic() + limit / SECOND
        if time.monotonic() > deadline or is_over():
            return LATE
        tell(active, str(facts["StatusText"]))
        time.sleep(_STEP_SECONDS)


class Gate:
    """The trial of a dataflow. options: of the release. `tell`: gets each step.

    `hear`: as read_heard(). may_wait: whether nodes may wait for what they need; then the trial
    does not wait for owed outputs.
    """

    def __init__(
        self,
        manager: Manager,
        scope: Scope,
        options: RunnerOptions,
        tell: Tell,
        hear: Callable[[Scope, str, Sequence[Owed]], Sequence[int]] = read_heard,
        may_wait: bool = False,
    ) -> None:
        self._may_wait = may_wait
        self._manager = manager
        self._scope = scope
        self._options = options
        self._unit = unit_name(options.name)
        self._tell = tell
        self._hear = hear
        # The other clock can be set back meanwhile, and then nothing would be since then.
        self._since_monotonic_us = time.monotonic_ns() // _MICROSECOND_NS
        self._boot = now_boot()
        self._before = self._invocation()
        self._looked = 0.0

    def run(self, start_limit: int, soak: int) -> Fault | None:
        """Restart the unit, and watch it for `soak` µs after its nodes are ready.

        Watches longer, until each owed output has arrived: a missing output would pass else.
        start_limit: µs until the nodes are ready. None if all is well. Raises DoraSystemdError.
        """
        with suppress(DoraSystemdError):  # systemd does not know a new unit
            self._manager.reset_failed(self._unit)
        self._manager.queue_job("RestartUnit", self._unit)
        fault = self._wait_ready(start_limit) or self._soak(soak)
        return fault and self._with_lines(fault)

    def _with_lines(self, fault: Fault) -> Fault:
        """Add what the node that failed has written last; of all nodes, if none is known."""
        invocation = self._invocation()
        words: tuple[Word, ...] = ()
        with suppress(DoraSystemdError):  # who may not read the journal has the reason only
            matches = scope_matches(self._scope, self._options.name)
            matches += [f"DORA_NODE={fault.node}"] if fault.node else []
            records = JournalReader().newest(matches, None, is_whole=True)
            words = choose_last(takewhile(self._is_new, records), LINES)
        lines = tuple(f"{one.node}: {one.text}" for one in shown_last(words, LINES))
        return fault._replace(invocation=invocation, lines=lines)

    def _wait_ready(self, limit: int) -> Fault | None:
        state = settle(self._manager, self._unit, limit, self._tell_start, self._has_failed)
        if state in SETTLED:
            return None
        if state == LATE:
            return self._fault() or Fault(f"not all nodes are ready after {format_duration(limit)}")
        return self._end(state)

    def _has_failed(self) -> bool:
        """Return whether a node has failed; checks once a second.

        dora would restart a node with a restart policy again and again, until the limit.
        """
        if time.monotonic() < self._looked + _LOOK_SECONDS:
            return False
        self._looked = time.monotonic()
        return self._fault() is not None

    def _tell_start(self, active: str, status: str) -> None:
        if active in (*SETTLED, "deactivating"):
            self._tell(stopping(status))
        else:  # the text of a unit that does not run is that of its last life
            self._tell(starting(status if active == "activating" else ""))

    def _soak(self, soak: int) -> Fault | None:
        invocation, begun = self._invocation(), time.monotonic()
        while True:
            passed = time.monotonic() - begun
            is_over = passed >= soak / SECOND
            facts = self._manager.read(self._unit, ["ActiveState", "StatusText"])
            state = str(facts["ActiveState"])
            if fault := self._fault():
                return fault
            if state not in SETTLED:
                return self._stopped(invocation)
            if self._invocation() != invocation:
                return self._restarted()
            late = self._unheard() if is_over else None
            self._tell(
                soaking(
                    str(facts["StatusText"]),
                    int(passed * SECOND),
                    soak,
                    awaited=late.place if late else "",
                )
            )
            if is_over and late is None:
                return None
            if late and passed > late.first / SECOND + _LOOK_SECONDS:
                how = f"no {late.output} within {format_duration(late.first)} of its start"
                return Fault(f"node {late.node}: silent, {how}", late.node)
            time.sleep(min(_LOOK_SECONDS, max(soak / SECOND - passed, _STEP_SECONDS)))

    def _stopped(self, invocation: str) -> Fault | None:
        """Wait until a stop is over, and judge it; before that nobody knows who stopped it."""

        def is_new() -> bool:
            return self._invocation() != invocation

        state = settle(self._manager, self._unit, START_LIMIT, self._tell_start, is_new)
        return self._end(state) if state in DOWN else self._restarted()

    def _restarted(self) -> Fault:
        if fault := self._fault():
            return fault
        if self._manager.read(self._unit, ["NRestarts"])["NRestarts"]:
            return Fault("systemd has restarted it")
        return Fault("it was restarted", is_outside=True)

    def _unheard(self) -> Owed | None:
        """The owed output that the trial has to wait for the longest, if any has not come yet."""
        owes = owes_of(self._options)
        if self._may_wait and any(one.name == WAITING for one in self._happenings()):
            return None
        pairs = zip(owes, self._hear(self._scope, self._options.name, owes), strict=True)
        late = (one for one, at in pairs if at < self._since_monotonic_us)
        return max(late, key=lambda one: one.first, default=None)

    def _end(self, state: str) -> Fault | None:
        """Judge the end of the unit: a dataflow may finish, everything else is a fault."""
        found = self._happenings()
        if fault := self._found(found):
            # The runner's own words have the number of restarts, and may name other nodes, too.
            words = failure_reason(self._manager, self._unit)
            is_same = words.startswith(f"node {fault.node}: ") and ", node " not in words
            return fault._replace(reason=words) if is_same else fault
        if refusal := runners_refusal(self._manager, self._unit):
            return Fault(refusal.message)
        if state == "inactive":
            is_done = is_finished(found)
            return None if is_done else _STOPPED
        return Fault(failure_reason(self._manager, self._unit))

    def _fault(self) -> Fault | None:
        return self._found(self._happenings())

    def _found(self, happenings: Sequence[Happening]) -> Fault | None:
        fault = find_fault(happenings, self._before, self._may_wait)
        if fault and fault.reason == BY_SIGKILL and self._is_kill_requested():
            return _STOPPED
        return fault

    def _is_kill_requested(self) -> bool:
        """Whether `stop --now` has ended the trial: then nothing must start instead."""
        name, kills = self._options.name, Kills()
        matches = [*scope_matches(self._scope, name), "DORA_EVENT=dataflow-failed"]
        matches += ["+", *kill_matches(self._scope, name)]
        with suppress(DoraSystemdError):
            records = JournalReader().newest(matches, _MOST_RECORDS)
            for one in takewhile(self._is_new, records):
                kills.read(one)
        return bool(kills.requested)

    def _happenings(self) -> list[Happening]:
        """Read the records of the trial, newest first."""
        matches = [*scope_matches(self._scope, self._options.name)]
        matches += [f"MESSAGE_ID={one}" for one in FAULT_IDS]
        found: list[Happening] = []
        with suppress(DoraSystemdError):  # who may not read the journal has systemd's word only
            records = JournalReader().newest(matches, _MOST_RECORDS)
            for one in map(parse_happening, filter(self._is_new, records)):
                found += [one] if one else []
        return found

    def _is_new(self, record: Mapping[str, Any]) -> bool:
        at_us = int(record.get("__MONOTONIC_TIMESTAMP", 0))
        return record.get("_BOOT_ID") == self._boot and at_us >= self._since_monotonic_us

    def _invocation(self) -> str:
        raw = self._manager.read(self._unit, ["InvocationID"])["InvocationID"]
        return bytes(raw).hex() if raw else ""

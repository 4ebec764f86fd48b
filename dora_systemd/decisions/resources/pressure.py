"""Decides when to report that memory or CPU time runs out, before a kill. Pure: no clock.

The runner samples each group with a limit every few seconds. An alarm is reported once; again only
after the group was well for a while, and QUIET has passed since the last report. So the journal is
not flooded.
"""

from collections.abc import Mapping
from typing import NamedTuple

from dora_systemd.decisions.resources.usage import WHOLE_CELL
from dora_systemd.values import SECOND, format_rounded_size

MEMORY, CPU = "memory-pressure", "cpu-throttled"
FULL, NOT_FULL = 0.9, 0.8
"""Shares of the limit used by memory that cannot be reclaimed: alarm above, well again below."""
STALLED, NOT_STALLED = 20.0, 5.0
"""Percent of the last 10 s in which some process waited for memory."""
THROTTLED, NOT_THROTTLED = 50.0, 25.0
"""Percent of the time in which the CPU limit throttled the group."""
BAD_LOOKS = {MEMORY: 1, CPU: 3}
"""Consecutive bad samples for an alarm: a starting program uses all the CPU time it can get."""
GOOD_LOOKS = 6
"""Consecutive good samples after which a group is well again."""
IDLE = 1.0
"""Percent of one processor below which a dataflow without limits does nothing worth a sample."""
QUIET = 300 * SECOND
"""µs between two reports of the same kind."""


class Load(NamedTuple):
    """One sample of a group."""

    held: int = 0  # bytes that the kernel cannot reclaim
    limit: int | None = None  # bytes, or None
    stalled: float = 0.0  # percent of the last 10 s in which some process waited for memory
    # percent of the time since the last sample in which the CPU limit throttled the group, None
    # without one
    throttled: float | None = None
    # percent of one processor: used since the last sample, and the limit, or None
    cpu: float = 0.0
    cpu_limit: float | None = None
    mapped: int = 0  # bytes of files that processes have mapped


class Most(NamedTuple):
    """The most that a group has used in any sample, as in Load."""

    held: int = 0
    cpu: float = 0.0
    used: int = 0  # held and mapped together

    def after(self, load: Load) -> "Most":
        """Return it after one more sample."""
        used = max(self.used, load.held + load.mapped)
        return Most(max(self.held, load.held), max(self.cpu, load.cpu), used)

    def details(self) -> dict[str, str]:
        """Details of the event with which a node or a dataflow ends; what is not known is left out.

        `advise` reads them.
        """
        known = {
            "held_peak": str(self.held or ""),
            "mapped_peak": str(self.used if self.used > self.held else ""),
            "cpu_peak": f"{self.cpu:.0f}" if self.cpu else "",
        }
        return {key: text for key, text in known.items() if text}


class Alarm(NamedTuple):
    """The state of one alarm."""

    # bad, good: consecutive samples
    bad: int = 0
    good: int = 0
    is_on: bool = False  # the alarm was reported and has not cleared
    reported_us: int = 0  # time, or 0


Report = tuple[str, str, Mapping[str, str]]
"""Event, node (WHOLE_CELL: the dataflow) and details."""

Alarms = Mapping[tuple[str, str], Alarm]
"""Alarms by node (WHOLE_CELL: the dataflow) and event."""


def look(alarms: Alarms, loads: Mapping[str, Load], now_us: int) -> tuple[Alarms, list[Report]]:
    """The alarms after one sample of all groups, and the new reports."""
    after = dict(alarms)  # keep alarms of groups without a limit at the moment
    reports = []
    for key, load in loads.items():
        for event, is_bad, is_good in _judged(load):
            old = after.get((key, event), Alarm())
            new = _counted(old, is_bad, is_good)
            if _is_due(new, event, now_us):
                new = new._replace(is_on=True, reported_us=now_us)
                reports.append(_report(event, key, load))
            after[key, event] = new
    return after, reports


def is_quiet(loads: Mapping[str, Load]) -> bool:
    """Whether the dataflow hardly uses CPU time, and no group has a limit that can be reached."""
    has_limits = any(one.limit is not None or one.throttled is not None for one in loads.values())
    return not has_limits and loads[WHOLE_CELL].cpu < IDLE


def _judged(load: Load) -> list[tuple[str, bool, bool]]:
    """Judge a sample for each limit: the event, whether the sample is bad, whether it is good."""
    judged = []
    if load.limit is not None:
        is_bad = load.held >= FULL * load.limit or load.stalled >= STALLED
        is_good = load.held < NOT_FULL * load.limit and load.stalled < NOT_STALLED
        judged.append((MEMORY, is_bad, is_good))
    if load.throttled is not None:
        judged.append((CPU, load.throttled >= THROTTLED, load.throttled < NOT_THROTTLED))
    return judged


def _counted(alarm: Alarm, is_bad: bool, is_good: bool) -> Alarm:
    good = alarm.good + 1 if is_good else 0
    is_on = alarm.is_on and good < GOOD_LOOKS
    return alarm._replace(bad=alarm.bad + 1 if is_bad else 0, good=good, is_on=is_on)


def _is_due(alarm: Alarm, event: str, now_us: int) -> bool:
    is_quiet = not alarm.reported_us or now_us - alarm.reported_us >= QUIET
    return not alarm.is_on and is_quiet and alarm.bad >= BAD_LOOKS[event]


def _report(event: str, key: str, load: Load) -> Report:
    is_whole = key == WHOLE_CELL
    whose = "its nodes together" if is_whole else f"node {key}"
    if event == CPU:
        share = f"{load.throttled or 0.0:.0f}"
        reason = f"{whose} had to wait for the limit {share}% of the time"
        own = {} if load.cpu_limit is None else {"cpu_limit": f"{load.cpu_limit:.0f}"}
        return (event, key, {"reason": reason, "throttled": share, **own})
    held, limit = format_rounded_size(load.held), format_rounded_size(load.limit or 0)
    stalled = f"{load.stalled:.0f}"
    holds = "hold" if is_whole else "holds"
    reason = f"{whose} {holds} {held} of {limit}, waiting {stalled}% of the time"
    details = {"held": str(load.held), "limit": str(load.limit), "stalled": stalled}
    return (event, key, {"reason": reason, **details})

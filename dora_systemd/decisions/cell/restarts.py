"""Restart policies: what is restarted, how often and when, in the terms of systemd and dora.

dora restarts nodes, and systemd restarts the dataflow. Both get the same policy. See
systemd.service(5), systemd.unit(5) and dora's descriptor.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import usage_error
from dora_systemd.values import (
    INFINITY,
    SECOND,
    format_duration,
    format_number,
    parse_duration,
    quoted,
)

POLICIES = ("no", "on-failure", "always")

DELAY = SECOND // 2
"""µs, the default. dora's is 0, and restarted a node that cannot start 37 times a second. Less
needs a budget that allows no more restarts in a window than this delay would."""

HEAD_START = 2 * SECOND // 5
"""µs. systemd starts the runner this long before the delay of a restart is over, and the runner
holds the nodes back: the sandbox, Python and dora are ready by then. What is left of
DELAY is systemd's own default, for a runner that does not get that far."""

MAX_RESTARTS = 1_000_000
MOST_COUNTED = 64
"""Maximum number of restarts that the runner counts. A larger budget is systemd's start limit."""
_HAND_STARTS = 30
"""Starts in one window that are no automatic restarts. StartLimitBurst= counts them as well, so it
is that much larger than the budget, which the runner keeps: see runner/cell/restarts.py."""
_COUNT = r"[0-9]{1,9}"


class RestartPolicy(NamedTuple):
    """An automatic restart policy. Times in µs."""

    policy: str = "no"  # one of POLICIES
    max_restarts: int = 5  # in one window, or INFINITY
    window: int = 600 * SECOND
    # before the first restart; it doubles with each restart, up to max_delay
    delay: int = DELAY
    max_delay: int = 30 * SECOND

    def dora_keys(self) -> dict[str, Any]:
        """The keys of a node in dora's descriptor, where 0 is no limit, and times are seconds."""
        if self.policy == "no":
            return {"restart_policy": "never"}
        is_endless = self.max_restarts == INFINITY
        window = {} if self.window == INFINITY else {"restart_window": self.window / SECOND}
        return {
            "restart_policy": self.policy,
            "max_restarts": 0 if is_endless else self.max_restarts,
            "restart_delay": self.delay / SECOND,
            "max_restart_delay": self.max_delay / SECOND,
            **window,
        }

    def delay_before(self, restart: int) -> int:
        """The delay before a restart, counted from 1 since the last quiet window, in µs."""
        return min(self.delay << min(max(restart - 1, 0), 64), self.max_delay)

    @property
    def unit_delay(self) -> int:
        """RestartSec= of the unit, in µs."""
        return max(self.delay - HEAD_START, 0)

    @property
    def unit_burst(self) -> int:
        """StartLimitBurst=, for which the first start counts too: 3 restarts are four starts."""
        return self.max_restarts + 1 + (_HAND_STARTS if self.max_restarts < MOST_COUNTED else 0)


DEFAULT = RestartPolicy()

HELD_SECONDS = 30 * 24 * 3600.0
HELD_KEYS: Mapping[str, Any] = {
    "restart_policy": "on-failure",
    "restart_delay": HELD_SECONDS,
    "max_restart_delay": HELD_SECONDS,
}
"""The keys of a node that waits after a failure. dora can replace such a node at any time, but
never one that it has given up."""

LATCH_SECONDS = 2.03125
LATCH_KEYS: Mapping[str, Any] = {
    "restart_policy": "on-failure",
    "max_restarts": 1,
    "restart_delay": LATCH_SECONDS,
    "max_restart_delay": LATCH_SECONDS,
}
"""The keys of a node without restarts that has needs. A driver whose device is unplugged often ends
by itself, and dora can replace it within this delay. If nothing is missing, the launcher fails in
the place of the node, and dora gives the node up."""


def parse_choice(text: str) -> str:
    """The word of a policy. Raises DoraSystemdError (USAGE)."""
    if (word := text.strip()) not in POLICIES:
        message = f"cannot use {quoted(word)} as restart policy"
        raise usage_error(message, f"valid values: {', '.join(POLICIES)}")
    return word


def parse_window(text: str) -> int:
    """µs after which something is reset or given up. Raises DoraSystemdError (USAGE)."""
    window = parse_duration(text)
    if window == 0:
        raise usage_error(f"cannot use a time of {quoted(text)}", "write a time such as 10min")
    return window


def parse_count(text: str) -> int:
    """A number of restarts, or INFINITY. Raises DoraSystemdError (USAGE)."""
    if text.strip() == "infinity":
        return INFINITY
    if not re.fullmatch(_COUNT, text.strip()) or not 1 <= int(text) <= MAX_RESTARTS:
        raise usage_error(
            f"cannot use {quoted(text)} as a number of restarts",
            "write 1 or more, or infinity; for none use --restart-policy no",
        )
    return int(text)


def parse_delay(text: str) -> int:
    """µs before a restart. Raises DoraSystemdError (USAGE)."""
    delay = parse_duration(text)
    if delay == INFINITY:
        message = f"cannot use {quoted(text)} as the delay of a restart"
        raise usage_error(message, "write a time such as 500ms, or 0 for none")
    return delay


def with_values(base: RestartPolicy, values: Mapping[str, Any], node: str = "") -> RestartPolicy:
    """`base` with some fields changed; the maximum delay is at least the first delay.

    node: whose policy it is, "" for the dataflow. Raises DoraSystemdError (USAGE) for a delay with
    which a crash loop would not end.
    """
    changed = base._replace(**values)
    if changed.delay < DELAY and changed.max_restarts * DELAY > changed.window:
        owner = f" of the node {quoted(node)}" if node else ""
        message = (
            f"cannot use restart_delay {format_duration(changed.delay)}{owner}: max_restarts"
            f" {format_number(changed.max_restarts)} in {format_duration(changed.window)} never"
            " ends a crash loop, which uses up the CPU"
        )
        hint = f"lower max_restarts, or use a restart_delay of {format_duration(DELAY)} or more"
        raise usage_error(message, hint)
    return changed._replace(max_delay=max(changed.max_delay, changed.delay))


_PARSERS: Sequence[Callable[[str], Any]] = (
    *(parse_choice, parse_count, parse_window, parse_delay, parse_delay),
)
POLICY_KEYS = (
    *("restart_policy", "max_restarts", "restart_window", "restart_delay", "max_restart_delay"),
)
"""The settings of a RestartPolicy, in the order of its fields."""
_FIELDS = dict(zip(POLICY_KEYS, zip(RestartPolicy._fields, _PARSERS, strict=True), strict=True))


@lru_cache(maxsize=4)
def restart_of(options: RunnerOptions) -> RestartPolicy:
    """The policy of the dataflow, and of nodes without one in the descriptor.

    Imports no module of settings: it is read before the coordinator starts. Raises
    DoraSystemdError.
    """
    return with_values(DEFAULT, given_policies(options).get("", {}))


def given_policies(options: RunnerOptions) -> dict[str, dict[str, Any]]:
    """The given fields of policies by node, "" for the dataflow. Raises DoraSystemdError."""
    found: dict[str, dict[str, Any]] = {}
    for node, key, text in options.settings:
        if key in _FIELDS:
            field, parse = _FIELDS[key]
            found.setdefault(node, {})[field] = parse(text)
    return found


def budget_words(budget: Mapping[str, int | None]) -> str:
    """Such as "3/5 restarts of the dataflow used, next try in 40s, resets in 8min".

    Times are in whole seconds.
    """
    parts = [f"{budget['used']}/{budget['max']} restarts of the dataflow used"]
    for key, words in (("next_us", "next try in"), ("resets_us", "resets in")):
        left = budget[key]
        if left is not None:
            parts.append(f"{words} {format_duration(-(-left // SECOND) * SECOND)}")
    return ", ".join(parts)


class Budget(NamedTuple):
    """The remaining restarts of a unit."""

    used: int  # in this window
    resets_in: int | None  # µs, or None


def unit_budget(
    starts: Sequence[int], max_restarts: int, window: int, now: int, counted: int
) -> Budget:
    """Return how much of the budget is used up.

    starts: CLOCK_REALTIME µs of the starts of the unit, oldest first: one by hand, and the
    automatic restarts since. counted: NRestarts=, which `doractl reset` clears.
    """
    begin, used = count_restarts(starts, window)
    if begin is None or now - begin >= window:
        return Budget(0, None)
    used = min(used, counted, max_restarts)
    return Budget(used, begin + window - now if used else None)


def count_restarts(starts: Sequence[int], window: int) -> tuple[int | None, int]:
    """Return when the last window began, and the restarts in it. starts: as for unit_budget().

    As in systemd, a window begins with a start and lasts `window` µs; the next start after its end
    begins another window.
    """
    begin, used = None, 0
    for start in starts:
        if begin is None or start - begin >= window:
            begin, used = start, 0
        else:
            used += 1
    return begin, used

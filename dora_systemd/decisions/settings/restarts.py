"""The settings of restarts."""

from typing import Any

from dora_systemd.decisions.cell.restarts import DEFAULT, POLICIES, parse_count, parse_delay
from dora_systemd.decisions.settings.kinds import DURATION, Base, Kind, Setting, one_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import (
    INFINITY,
    format_duration,
    format_number,
    parse_duration,
    quoted,
    scalar_text,
)


def _parse_choice(value: Any, _: Base) -> str:
    # YAML reads a bare `no` as false.
    text = "no" if value is False else scalar_text(value).strip()
    if text not in POLICIES:
        message = f"cannot use {quoted(text)} as restart policy"
        raise DoraSystemdError(message, f"valid values: {', '.join(POLICIES)}", ExitCode.USAGE)
    return text


def _parse_window(text: str) -> int:
    window = parse_duration(text)
    if window == 0:
        message = f"cannot use {quoted(text)} as the window of restarts"
        raise DoraSystemdError(message, "write a time such as 10min", ExitCode.USAGE)
    return window


_COUNT = one_text(int | str, "a number of restarts", "N", parse_count, format_number)
_WINDOW = one_text(DURATION.schema, DURATION.expected, "TIME", _parse_window, format_duration)
_DELAY = one_text(DURATION.schema, DURATION.expected, "TIME", parse_delay, format_duration)

_CHOICE = Kind[str](
    bool | str, "no, on-failure or always", _parse_choice, lambda value: [value], metavar="POLICY"
)
RESTART_POLICY = Setting[str](
    "restart_policy",
    _CHOICE,
    DEFAULT.policy,
    "When to restart automatically: no, on-failure or always.",
    per_node=True,
)
MAX_RESTARTS = Setting[int](
    "max_restarts", _COUNT, DEFAULT.max_restarts, "Maximum restarts per window.", per_node=True
)
RESTART_WINDOW = Setting[int](
    "restart_window",
    _WINDOW,
    DEFAULT.window,
    "Time after which the restart counter is reset.",
    per_node=True,
)
RESTART_DELAY = Setting[int](
    "restart_delay",
    _DELAY,
    DEFAULT.delay,
    "Delay before a restart; doubles with each restart.",
    per_node=True,
)
MAX_RESTART_DELAY = Setting[int](
    "max_restart_delay", _DELAY, DEFAULT.max_delay, "Longest delay before a restart.", per_node=True
)
START_TIMEOUT = Setting[int](
    "start_timeout", _WINDOW, INFINITY, "Time for all nodes to become ready; infinity for no limit."
)

POLICY_SETTINGS: tuple[Setting[Any], ...] = (
    *(RESTART_POLICY, MAX_RESTARTS, RESTART_WINDOW, RESTART_DELAY, MAX_RESTART_DELAY),
)
"""The settings of a RestartPolicy, in the order of its fields."""

RESTART_SETTINGS = (*POLICY_SETTINGS, START_TIMEOUT)

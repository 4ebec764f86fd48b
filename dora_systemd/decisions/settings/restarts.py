"""The settings of restarts."""

from typing import Any

from dora_systemd.decisions.cell.restarts import DEFAULT, POLICIES, parse_count, parse_delay
from dora_systemd.decisions.settings.kinds import DURATION, Base, Kind, Setting, scalar_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, format_duration, parse_duration, quoted


def _parse_choice(value: Any, base: Base) -> str:
    del base
    # YAML reads a bare `no` as false.
    text = "no" if value is False else scalar_text(value).strip()
    if text not in POLICIES:
        message = f"cannot use {quoted(text)} as restart policy"
        raise DoraSystemdError(message, f"valid values: {', '.join(POLICIES)}", ExitCode.USAGE)
    return text


def _parse_window(value: Any, base: Base) -> int:
    del base
    window = parse_duration(scalar_text(value))
    if window == 0:
        message = f"cannot use {quoted(scalar_text(value))} as the window of restarts"
        raise DoraSystemdError(message, "write a time such as 10min", ExitCode.USAGE)
    return window


def _format_count(count: int) -> str:
    return "infinity" if count == INFINITY else str(count)


_COUNT = Kind[int](
    int | str,
    "a number of restarts",
    lambda value, _: parse_count(scalar_text(value)),
    lambda value: [_format_count(value)],
)
_WINDOW = Kind[int](
    str | int | float, DURATION.expected, _parse_window, lambda value: [format_duration(value)]
)
_DELAY = Kind[int](
    str | int | float,
    DURATION.expected,
    lambda value, _: parse_delay(scalar_text(value)),
    lambda value: [format_duration(value)],
)

RESTART_POLICY = Setting[str](
    "restart_policy",
    Kind[str](bool | str, "no, on-failure or always", _parse_choice, lambda value: [value]),
    DEFAULT.policy,
    "When to restart automatically: no, on-failure or always.",
    flags=("--restart-policy",),
    variable="DORA_RESTART_POLICY",
    metavar="POLICY",
    per_node=True,
)
MAX_RESTARTS = Setting[int](
    "max_restarts",
    _COUNT,
    DEFAULT.max_restarts,
    "Maximum restarts per window.",
    flags=("--max-restarts",),
    variable="DORA_MAX_RESTARTS",
    metavar="N",
    per_node=True,
)
RESTART_WINDOW = Setting[int](
    "restart_window",
    _WINDOW,
    DEFAULT.window,
    "Time after which the restart counter is reset.",
    flags=("--restart-window",),
    variable="DORA_RESTART_WINDOW",
    metavar="TIME",
    per_node=True,
)
RESTART_DELAY = Setting[int](
    "restart_delay",
    _DELAY,
    DEFAULT.delay,
    "Delay before a restart; doubles with each restart.",
    flags=("--restart-delay",),
    variable="DORA_RESTART_DELAY",
    metavar="TIME",
    per_node=True,
)
MAX_RESTART_DELAY = Setting[int](
    "max_restart_delay",
    _DELAY,
    DEFAULT.max_delay,
    "Longest delay before a restart.",
    flags=("--max-restart-delay",),
    variable="DORA_MAX_RESTART_DELAY",
    metavar="TIME",
    per_node=True,
)
START_TIMEOUT = Setting[int](
    "start_timeout",
    _WINDOW,
    INFINITY,
    "Time for all nodes to become ready; infinity for no limit.",
    flags=("--start-timeout",),
    variable="DORA_START_TIMEOUT",
    metavar="TIME",
)

RESTART_SETTINGS: tuple[Setting[Any], ...] = (
    *(RESTART_POLICY, MAX_RESTARTS, RESTART_WINDOW, RESTART_DELAY, MAX_RESTART_DELAY),
    START_TIMEOUT,
)

"""The settings of restarts."""

from typing import Any

from dora_systemd.decisions.cell.restarts import (
    DEFAULT,
    parse_choice,
    parse_count,
    parse_delay,
    parse_window,
)
from dora_systemd.decisions.settings.kinds import DURATION, Base, Kind, Setting, one_text
from dora_systemd.values import INFINITY, format_duration, format_number, scalar_text


def _parse_choice(value: Any, _: Base) -> str:
    # YAML reads a bare `no` as false.
    return "no" if value is False else parse_choice(scalar_text(value))


_COUNT = one_text(int | str, "a number of restarts", "N", parse_count, format_number)
_WINDOW = one_text(DURATION.schema, DURATION.expected, "TIME", parse_window, format_duration)
_DELAY = one_text(DURATION.schema, DURATION.expected, "TIME", parse_delay, format_duration)

_CHOICE = Kind[str](
    bool | str, "no, on-failure or always", _parse_choice, lambda value: [value], metavar="POLICY"
)


def _policy_setting(name: str, kind: Kind[Any], default: Any, help_text: str) -> Setting[Any]:
    # The head decides whether dora restarts a node, wherever that node runs.
    return Setting(name, kind, default, help_text, per_node=True, on_head=True, on_members=False)


RESTART_POLICY: Setting[str] = _policy_setting(
    "restart_policy",
    _CHOICE,
    DEFAULT.policy,
    "When to restart automatically: no, on-failure or always.",
)
MAX_RESTARTS: Setting[int] = _policy_setting(
    "max_restarts", _COUNT, DEFAULT.max_restarts, "Maximum restarts per window."
)
RESTART_WINDOW: Setting[int] = _policy_setting(
    "restart_window", _WINDOW, DEFAULT.window, "Time after which the restart counter is reset."
)
RESTART_DELAY: Setting[int] = _policy_setting(
    "restart_delay",
    _DELAY,
    DEFAULT.delay,
    "Delay before a restart, 0 for none; doubles with each restart.",
)
MAX_RESTART_DELAY: Setting[int] = _policy_setting(
    "max_restart_delay", _DELAY, DEFAULT.max_delay, "Longest delay before a restart."
)
START_TIMEOUT = Setting[int](
    "start_timeout", _WINDOW, INFINITY, "Time for all nodes to become ready; infinity for no limit."
)

POLICY_SETTINGS: tuple[Setting[Any], ...] = (
    *(RESTART_POLICY, MAX_RESTARTS, RESTART_WINDOW, RESTART_DELAY, MAX_RESTART_DELAY),
)
RESTART_SETTINGS = (*POLICY_SETTINGS, START_TIMEOUT)
RUNNER_SETTINGS = {one.name: one for one in POLICY_SETTINGS}

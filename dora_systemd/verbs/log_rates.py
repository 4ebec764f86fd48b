"""`doractl set --log-rate-limit`: changes limits of log lines, at once and for the next runners."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dora_systemd.adapters.runner_socket.client import order
from dora_systemd.decisions.cell.environment import with_changes
from dora_systemd.decisions.cell.line_rates import (
    CHANGES_VARIABLE,
    RateLimits,
    format_changes,
    format_rates,
    parse_changes,
)
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.node import socket_of

Ask = Callable[[Path, Mapping[str, Any]], dict[str, Any]]


def changed_rates(environment: Mapping[str, str], given: RateLimits) -> str:
    """The new CHANGES_VARIABLE of a unit with that environment."""
    return format_changes({**parse_changes(environment.get(CHANGES_VARIABLE, "")), **given})


def limit_lines(
    scope: Scope,
    cell: Cell,
    environment: Mapping[str, str],
    given: RateLimits,
    undo: ExitStack,
    ask: Ask = order,
) -> None:
    """Have the runner apply the limits `given`, with those that it has. Raises DoraSystemdError.

    environment: that of the unit before the change.
    """
    path, before = socket_of(scope, cell), with_changes(cell.options, environment).log_rates
    ask(path, _request({**before, **given}))
    undo.callback(ask, path, _request(before))


def _request(rates: RateLimits) -> Mapping[str, Any]:
    return {"verb": "log-rates", "limits": format_rates(rates)}

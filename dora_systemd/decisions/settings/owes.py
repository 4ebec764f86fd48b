"""The settings of what nodes owe: messages on outputs, and signs of life, see sd_notify(3)."""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.launch import is_launched, watchdogs_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import (
    KEYS,
    Owed,
    check_owes,
    distinct,
    format_owed,
    owed_of,
    owes_of,
    parse_owed,
    policies_of,
)
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.settings.kinds import (
    BOOL,
    Base,
    Kind,
    Scalar,
    Setting,
    listed,
    one_text,
)
from dora_systemd.decisions.watchdog.watchdogs import check_watchdogs, parse_watchdog
from dora_systemd.values import INFINITY, format_duration, scalar_text


def _parse(value: Any, _: Base) -> tuple[Owed, ...]:
    """From texts, and from mappings as a settings file has them."""
    return distinct(map(_parse_one, listed(value)))


def _parse_one(value: Any) -> Owed:
    if isinstance(value, Mapping):
        return owed_of({key: scalar_text(one) for key, one in value.items()})
    return parse_owed(scalar_text(value))


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    check_owes(owes_of(options), policies_of(options), nodes)


_OWED = Kind[tuple[Owed, ...]](
    str | dict[str, Scalar] | list[str | dict[str, Scalar]],
    "{output: image, within: 2s}, OUTPUT:within=2s, or a list of them",
    _parse,
    lambda owes: list(map(format_owed, owes)),
    is_repeatable=True,
    keys=KEYS,
)
OWES = Setting[tuple[Owed, ...]](
    "owes",
    _OWED,
    (),
    "Output on which messages must come in time; else restart the node, warn, or fail.",
    only_nodes=True,
    on_members=False,
    check=_check,
)
OWES_SETTINGS: tuple[Setting[Any], ...] = (OWES,)


def check_sockets(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that cannot have a notify socket."""
    check_watchdogs(watchdogs_of(options), {node.id for node in nodes if is_launched(node)})


WATCHDOG = Setting[int](
    "watchdog",
    one_text(str, "a time span such as 5s", "TIME", parse_watchdog, format_duration),
    INFINITY,
    "Time in which each node must send WATCHDOG=1; one that does not is ended.",
    per_node=True,
    outlives_node=True,
    check=check_sockets,
)
NOTIFY = Setting[bool](
    "notify",
    BOOL,
    False,
    "Give the nodes a notify socket, to report their STATUS=.",
    per_node=True,
    outlives_node=True,
    check=check_sockets,
)
SIGN_SETTINGS: tuple[Setting[Any], ...] = (WATCHDOG, NOTIFY)
RUNNER_SETTINGS = {one.name: one for one in (OWES, WATCHDOG, NOTIFY)}

"""The settings of what nodes owe: messages on outputs, and signs of life, see sd_notify(3)."""

from collections.abc import Mapping, Sequence
from operator import or_
from typing import Any

from dora_systemd.decisions.cell.launch import is_launched, watchdogs_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import (
    Owed,
    check_owes,
    format_owed,
    merge_owed,
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
    by_named_node,
    listed,
    many_texts,
)
from dora_systemd.decisions.watchdog.watchdogs import (
    HINT,
    Watchdogs,
    check_watchdogs,
    format_watchdogs,
    parse_watchdogs,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted, scalar_text


def _parse(value: Any, _: Base) -> tuple[Owed, ...]:
    """From texts that name the node, and from mappings in the place of a node."""
    return merge_owed(map(_parse_one, listed(value)))


def _parse_one(value: Any) -> Owed:
    if isinstance(value, Mapping):
        return owed_of({key: scalar_text(one) for key, one in value.items()})
    text = scalar_text(value)
    # The form of format_owed() for an output without its node.
    is_nameless = text.startswith("/")
    return parse_owed(f"_{text}")._replace(node="") if is_nameless else parse_owed(text)


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    check_owes(owes_of(options), policies_of(options), nodes)


def _by_node(
    nodes: Mapping[str, tuple[Owed, ...]], given: tuple[Owed, ...]
) -> dict[str, dict[str, tuple[Owed, ...]]]:
    found: dict[str, list[Owed]] = {}
    for one in merged_owes(nodes, given):
        found.setdefault(one.node, []).append(one._replace(node=""))
    return {node: {"owes": tuple(owes)} for node, owes in found.items()}


_OWED = Kind[tuple[Owed, ...]](
    str | dict[str, Scalar] | list[str | dict[str, Scalar]],
    "below a node {output: image, within: 2s}, else NODE/OUTPUT:within=2s",
    _parse,
    lambda owes: list(map(format_owed, owes)),
    is_repeatable=True,
    merge=merge_owed,
    metavar="NODE/OUTPUT:within=TIME,...",
)
OWES = Setting[tuple[Owed, ...]](
    "owes",
    _OWED,
    (),
    "Output on which messages must come in time; else restart the node, warn, or fail.",
    per_node=True,
    on_members=False,
    by_node=_by_node,
    check=_check,
)
OWES_SETTINGS: tuple[Setting[Any], ...] = (OWES,)


def merged_owes(nodes: Mapping[str, tuple[Owed, ...]], given: tuple[Owed, ...]) -> tuple[Owed, ...]:
    """The outputs of `given`, which take precedence over those that a settings file has for nodes.

    Raises DoraSystemdError (BAD_INPUT) for one that names its node where the place does, or not
    where it must.
    """
    for one in given:
        if not one.node:
            hint = f"write it below nodes: NODE:, or as NODE/{one.output}:within=TIME"
            raise _refusal(f"the output {quoted(one.output)} without its node", hint)
    for node, owes in nodes.items():
        if named := [one for one in owes if one.node]:
            hint = "write {output: NAME, within: TIME} there"
            raise _refusal(f"{quoted(named[0].place)} below the node {quoted(node)}", hint)
    of_files = [one._replace(node=node) for node, owes in nodes.items() for one in owes]
    return merge_owed(of_files, given)


def _refusal(what: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(f"cannot use {what} as owes", hint, ExitCode.BAD_INPUT)


def check_sockets(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that cannot have a notify socket."""
    check_watchdogs(watchdogs_of(options), {node.id for node in nodes if is_launched(node)})


WATCHDOG = Setting[Watchdogs](
    "watchdog",
    many_texts("a time span such as 5s", "[NODE=]TIME", parse_watchdogs, format_watchdogs, or_),
    {},
    "Time in which all nodes, or NODE, must send WATCHDOG=1; one that does not is ended.",
    variable="DORA_WATCHDOG",
    per_node=True,
    outlives_node=True,
    by_node=by_named_node("watchdog", format_watchdogs, HINT),
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

"""What the shells ask for at the Tab key: options and verbs from click, and what runs.

The scripts in packaging/completions set _DORACTL_COMPLETE and speak click's own protocol, see
https://click.palletsprojects.com/shell-completion. Nothing here may print or fail: a key was
pressed in the middle of somebody's line.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import click
from click.shell_completion import CompletionItem, shell_complete

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.cli.group import VERBS, VerbGroup, doractl
from dora_systemd.cli.parameters import current_scope
from dora_systemd.decisions.properties.sandbox import LEVELS, NETWORKS
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_uuid_prefix

VARIABLE = "_DORACTL_COMPLETE"

_OF_THE_PAST = ("logs", "why")
"""Verbs that find dataflows which only the journal knows."""

_RUNNING_ONLY = ("stop", "dora", "env", "top")
"""Verbs that have nothing to do with a dataflow that has failed."""


class Live(click.types.StringParamType):
    """The type of an argument whose values are what there is now."""

    def __init__(self, values: Callable[[click.Context, str], Iterable[str]]) -> None:
        self.values = values

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        del param
        try:
            with ctx.scope(cleanup=False):
                found = list(self.values(ctx, incomplete))
        except (DoraSystemdError, OSError):
            return []
        return [CompletionItem(one) for one in found if one.startswith(incomplete)]


def dataflow_names(ctx: click.Context, incomplete: str) -> list[str]:
    """The dataflows that systemd knows and, for logs, the journal; by UUID if that is begun."""
    from dora_systemd.verbs.facts.cells import read_cells

    verb = ctx.command.name or ""
    cells = [cell for cell in read_cells(_bus()) if cell.is_up or verb not in _RUNNING_ONLY]
    names = [cell.name for cell in cells] + (
        JournalReader().known_names() if verb in _OF_THE_PAST else []
    )
    if is_uuid_prefix(incomplete) and not any(name.startswith(incomplete) for name in names):
        return [cell.uuid for cell in cells]
    given = ctx.params.get("selectors") or ()
    return [name for name in dict.fromkeys(names) if name not in given]


def node_names(ctx: click.Context, incomplete: str) -> list[str]:
    """The nodes of the dataflow that the line names already."""
    from dora_systemd.verbs.facts.cells import read_cells, select_cell
    from dora_systemd.verbs.facts.list import dataflow_row

    del incomplete
    # Behind an option without its value click leaves the arguments where they are.
    selector = ctx.params.get("selector") or next(iter(ctx.args), "")
    if ctx.command.name == "logs":
        return JournalReader().known_nodes(selector)
    bus = _bus()
    row = dataflow_row(bus, current_scope(), select_cell(read_cells(bus), selector))
    return [one.node for one in row.nodes]


# By name of the parameter, whichever verb it belongs to.
TYPES: dict[str, Any] = {
    "selector": Live(dataflow_names),
    "selectors": Live(dataflow_names),
    "node": Live(node_names),
    "nodes": Live(node_names),
    "level": click.Choice(["error", "warn", "info", "debug", "trace"]),
    "run": click.Choice(["CURRENT", "PREVIOUS", "ALL"]),
    "dataflow": click.File(),
    "dora": click.File(),
    "env_file": click.File(),
    "venv": click.Path(file_okay=False),
    "working_directory": click.Path(file_okay=False),
    "writable": click.Path(),
    "sandbox": click.Choice(LEVELS),
    "network": click.Choice(NETWORKS),
}


class CompletingGroup(VerbGroup):
    """doractl's verbs, whose parameters know what could stand in their place."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = super().get_command(ctx, cmd_name)
        for one in getattr(command, "commands", {}).values():
            _set_types(one)
        return command and _set_types(command)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Verbs from the table, which imports none of them, and the options beside them."""
        verbs = [
            CompletionItem(name, help=verb.summary)
            for name, verb in VERBS.items()
            if name.startswith(incomplete)
        ]
        return [*verbs, *click.Command.shell_complete(self, ctx, incomplete)]


def complete(instruction: str) -> int:
    """Print what fits, as `instruction` says: bash_complete, zsh_complete or fish_complete."""
    group = CompletingGroup("doractl", params=doractl.params)
    with suppress(DoraSystemdError):
        return shell_complete(group, {}, "doractl", VARIABLE, instruction)
    return ExitCode.USAGE


def _set_types(command: click.Command) -> click.Command:
    for param in command.params:
        param.type = TYPES.get(param.name or "", param.type)
    return command


def _bus() -> Bus:
    return Bus(current_scope(), for_reading=True)

"""Shell completion: options and verbs from click, and the names of dataflows and nodes.

The scripts in packaging/completions set _DORACTL_COMPLETE and use click's own protocol, see
https://click.palletsprojects.com/shell-completion. This code must not print or fail, because the
user is in the middle of a command line.
"""

import os
import pwd
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import copy
from typing import Any

import click
from click.shell_completion import CompletionItem, shell_complete

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.cli.group import SHOWN, VerbGroup, doractl
from dora_systemd.cli.parameters import current_scope, is_elsewhere
from dora_systemd.decisions.cell.restarts import POLICIES
from dora_systemd.decisions.properties.sandbox import LEVELS, NETWORKS
from dora_systemd.decisions.settings.reload import REPLACE_WORDS
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_name, is_uuid_prefix
from dora_systemd.scope import Scope

VARIABLE = "_DORACTL_COMPLETE"

_OF_THE_PAST = ("advise", "bundle", "list", "logs", "restart", "start", "why")
"""Verbs that also accept dataflows that only the journal knows."""

_RUNNING_ONLY = ("stop", "dora", "env", "top")
"""Verbs that do not accept failed dataflows."""


class Live(click.types.StringParamType):
    """The type of an argument whose values are existing names."""

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


class FileOrName(Live):
    """The type of what `start` takes: names only once there is a word, as bash shows either."""

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = super().shell_complete(ctx, param, incomplete) if incomplete else []
        return [*names, CompletionItem(incomplete, type="file")]


def dataflow_names(ctx: click.Context, incomplete: str) -> list[str]:
    """The dataflows of systemd, for some verbs of the journal; UUIDs if the word looks like one."""
    from dora_systemd.verbs.facts.cells import read_cells

    if is_elsewhere():
        return []
    verb = ctx.command.name or ""
    cells = [cell for cell in read_cells(_bus()) if cell.is_up or verb not in _RUNNING_ONLY]
    names = [cell.name for cell in cells] + (
        JournalReader().known_names(current_scope()) if verb in _OF_THE_PAST else []
    )
    if is_uuid_prefix(incomplete) and not any(name.startswith(incomplete) for name in names):
        return [cell.uuid for cell in cells]
    given = ctx.params.get("selectors") or ()
    return [name for name in dict.fromkeys(names) if name not in given]


def host_names(_ctx: click.Context, incomplete: str) -> list[str]:
    """Complete a list of hosts: every host of the hosts file, after the text before it."""
    from dora_systemd.verbs.remote.hosts import listed_hosts

    before, comma, _ = incomplete.rpartition(",")
    given = before.split(",")
    words = ["all", *(host.text for host in listed_hosts(os.environ))]
    return [f"{before}{comma}{one}" for one in words if one not in given]


def node_names(ctx: click.Context, incomplete: str) -> list[str]:
    """The nodes of the dataflow that is on the command line."""
    from dora_systemd.verbs.facts.list import dataflow_row
    from dora_systemd.verbs.facts.selector import Selector

    del incomplete
    if is_elsewhere():
        return []
    # After an option without its value, click leaves the arguments in ctx.args.
    if ctx.command.name == "logs":
        journal, given = JournalReader(), ctx.params.get("selectors") or ctx.args
        scope = current_scope()
        return [node for one in given for node in journal.known_nodes(scope, one)]
    selector = ctx.params.get("selector") or next(iter(ctx.args), "")
    bus = _bus()
    row = dataflow_row(bus, current_scope(), Selector(selector).find(bus))
    return [one.node for one in row.nodes]


def release_ids(ctx: click.Context, _incomplete: str) -> list[str]:
    """The releases of the dataflow that is on the command line."""
    from dora_systemd.verbs.releases.listing import store_of

    return _known_ids(ctx, store_of)


def bundle_names(ctx: click.Context, _incomplete: str) -> list[str]:
    """The bundles of the dataflow that is on the command line."""
    from dora_systemd.verbs.bundles.listing import store_of

    return _known_ids(ctx, store_of)


def _known_ids(ctx: click.Context, store_of: Callable[[Scope, str], Any]) -> list[str]:
    name = ctx.params.get("selector") or next(iter(ctx.args), "")
    if is_elsewhere() or not is_name(name):
        return []
    return [one.id for one in store_of(current_scope(), name).known()]


# By name of the parameter, for all verbs.
TYPES: dict[str, Any] = {
    "selector": Live(dataflow_names),
    "selectors": Live(dataflow_names),
    "node": Live(node_names),
    "nodes": Live(node_names),
    "pattern": Live(dataflow_names),
    "level": Live(lambda *_: ["error", "warn", "info", "debug", "trace", "stdout"]),
    "release": Live(release_ids),
    "run": click.Choice(["CURRENT", "PREVIOUS", "ALL"]),
    "dataflow": FileOrName(
        lambda ctx, word: dataflow_names(ctx, word) if ctx.command.name == "start" else []
    ),
    "dora": click.File(),
    "env_file": click.File(),
    "device": click.File(),
    "file": click.File(),
    "bundle": Live(bundle_names),
    "user": Live(lambda *_: [one.pw_name for one in pwd.getpwall()]),
    "host": Live(host_names),
    "restart_policy": click.Choice(POLICIES),
    "replace": click.Choice(REPLACE_WORDS),
    "venv": click.Path(file_okay=False),
    "working_directory": click.Path(file_okay=False),
    "writable": click.Path(),
    "sandbox": click.Choice(LEVELS),
    "network": click.Choice(NETWORKS),
}


_VERB = Live(lambda *_: SHOWN)


class CompletingGroup(VerbGroup):
    """The verbs of doractl, with completion for their parameters."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name == "help":  # no verb of the table: `doractl help VERB` is VERB --help
            return click.Command("help", params=[click.Argument(["verb"], type=_VERB)])
        command = super().get_command(ctx, cmd_name)
        return command and _completing(command)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete verbs from the table, without importing them, and options."""
        verbs = [
            CompletionItem(name, help=verb.summary)
            for name, verb in SHOWN.items()
            if name.startswith(incomplete)
        ]
        return [*verbs, *click.Command.shell_complete(self, ctx, incomplete)]


def complete(instruction: str) -> int:
    """Print completions for `instruction`: bash_complete, zsh_complete or fish_complete."""
    group = CompletingGroup("doractl", params=_typed(doractl.params))
    with suppress(DoraSystemdError):
        return shell_complete(group, {}, "doractl", VARIABLE, instruction)
    return ExitCode.USAGE


def _completing(command: click.Command) -> click.Command:
    """A copy with the types above, which would refuse values that the verb takes."""
    command = copy(command)
    command.params = _typed(command.params)
    if isinstance(command, click.Group):
        command.commands = {name: _completing(one) for name, one in command.commands.items()}
    return command


def _typed(params: Iterable[click.Parameter]) -> list[click.Parameter]:
    copies = list(map(copy, params))
    for param in copies:
        param.type = TYPES.get(param.name or "", param.type)
    return copies


def _bus() -> Bus:
    return Bus(current_scope(), for_reading=True)

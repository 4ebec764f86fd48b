"""doractl -H: click reads the command line here, and the verb runs on the hosts."""

import os
import sys
from collections.abc import Sequence, Set
from copy import copy
from pathlib import Path
from typing import Any

import click

from dora_systemd.cli.edge import with_target
from dora_systemd.cli.group import SELECTORS, VerbGroup, doractl, run_verb
from dora_systemd.cli.remote.plan import ROLLOUTS, Plan, check_hosts, plan_of, valued_flags
from dora_systemd.cli.remote.run import is_terminal, pass_through, run_on_all, run_there
from dora_systemd.decisions.remote.command_line import part_hosts
from dora_systemd.decisions.remote.hosts import ALL, Host, given_words
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.paths import exists
from dora_systemd.verbs.remote.hosts import find_hosts


def run_elsewhere(arguments: list[str]) -> int:
    """Run a command line that may have -H; its exit status. Raises DoraSystemdError."""
    given, words = part_hosts(arguments, valued_options)
    if not given:
        return run_verb(words)
    hosts = given_words(given)

    def run(**_options: Any) -> int:
        return _run(click.get_current_context(), hosts, words)

    class Elsewhere(VerbGroup):
        """The verbs of doractl; each runs on the hosts."""

        def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
            command = super().get_command(ctx, cmd_name)
            return command and _with_callback(command, run)

    try:
        return run_verb(words, _like(doractl, Elsewhere))
    except DoraSystemdError as error:
        if error.code is not ExitCode.USAGE:
            raise
        hint = with_target(error.hint, ",".join(given))
        raise DoraSystemdError(error.message, hint, error.code) from error


def _like(group: click.Group, kind: type[click.Group]) -> click.Group:
    return kind(
        group.name,
        params=group.params,
        callback=group.callback,
        help=group.help,
        epilog=group.epilog,
        invoke_without_command=group.invoke_without_command,
        context_settings=group.context_settings,
    )


def _with_callback(command: click.Command, run: Any) -> click.Command:
    """A copy of a verb, or of a group of verbs, that does something else."""
    command = copy(command)
    if isinstance(command, click.Group):
        members = command.commands.items()
        command.commands = {name: _with_callback(one, run) for name, one in members}
    else:
        command.callback = run
        if any(one.name in SELECTORS for one in command.params):
            command.params = list(map(_without_need, command.params))
    return command


def _without_need(param: click.Parameter) -> click.Parameter:
    """A copy of a parameter of a verb that reports there if it is missing, with the names there."""
    param = copy(param)
    if isinstance(param, click.Argument) and param.required:
        param.metavar, param.required = param.human_readable_name, False
    return param


def valued_options(verb: str) -> Set[str]:
    """The options of a verb that have a value."""
    command = doractl.get_command(click.Context(doractl), verb)
    members = getattr(command, "commands", {}).values()
    return {flag for one in (command, *members) if one for flag in valued_flags(one)}


def _run(context: click.Context, words: list[str], command_line: list[str]) -> int:
    plan = plan_of(context, command_line)
    check_hosts(plan, 1)
    hosts = find_hosts(words, os.environ)
    check_hosts(plan, len(hosts))
    status = _run_on(hosts, plan, is_several=len(hosts) > 1 or ALL in words)
    if status == ExitCode.BAD_INPUT and not plan.wants_json:
        where = "that host" if len(hosts) > 1 else hosts[0].text
        if hint := plan.file_hint(where, exists(Path(plan.file).absolute())):
            print(f"hint: {hint}", file=sys.stderr)
    return status


def _run_on(hosts: Sequence[Host], plan: Plan, is_several: bool) -> int:
    if plan.verb == "deploy" or (plan.verb in ROLLOUTS and is_several):
        # Imported late: it reads projects.
        from dora_systemd.cli.remote.rollout import roll_out

        return roll_out(hosts, plan)
    if is_several:
        return run_on_all(hosts, plan)
    return run_there(hosts[0], plan) if is_terminal() else pass_through(hosts[0], plan)

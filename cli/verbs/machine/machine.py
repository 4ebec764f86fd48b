"""Add, list, check or remove machines of dataflows."""

import os
from collections.abc import Sequence

import click

from dora_systemd.cli.group import SubverbGroup
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    output_option,
    print_json,
    print_warnings,
    scope_options,
    tell,
    wants_json,
)
from dora_systemd.decisions.machines.description import summary
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.machines.register import (
    Known,
    add_machine,
    check_machine,
    chosen,
    known_machines,
    remove_machine,
)

_HEADER = ("NAME", "HOST", "KEY")
_NONE = "No machine is declared."


@click.group("machine", cls=SubverbGroup, no_args_is_help=False)
@scope_options
def command() -> None:
    """Add, list, check or remove machines of dataflows that run on several.

    A machine that was added can be named in deploy.machine of any dataflow, see
    dora-systemd-machines(7).

    Examples:
      doractl machine add alice@gpu-box --name gpu
      doractl machine list
      doractl machine check
      doractl machine remove gpu
    """


@command.command("add")
@click.argument("destination", metavar="HOST")
@click.option("--name", metavar="NAME", help="Its name in dataflows; default: that of HOST.")
@acting_options
def add(destination: str, name: str | None) -> None:
    """Let dataflows run nodes on [user@]HOST, without a password from now on.

    Logs in once with your own keys, makes a key that can do nothing else over there, and declares
    the machine in config.yml.
    """
    scope, host = current_scope(), parse_host(destination)
    name = name or host.destination.rpartition("@")[2].partition(".")[0]
    for line in add_machine(scope, os.environ, host, name):
        tell(line)
    if wants_json():
        print_json([_object(one) for one in chosen(known_machines(scope, os.environ), (name,))])


@command.command("list")
@output_option
@scope_options
def show(output: str) -> None:
    """List the machines that every dataflow can name."""
    known = known_machines(current_scope(), os.environ)
    if output == "json":
        print_json([_object(one) for one in known])
    elif not known:
        click.echo(_NONE)
    else:
        rows = [(one.name, one.host.text, one.key or "yours") for one in known]
        print_table(lambda width, colors: format_table(_HEADER, rows, width, colors))


@command.command("check")
@click.argument("names", nargs=-1, metavar="[NAME...]")
@output_option
@scope_options
def check(names: tuple[str, ...], output: str) -> int:
    """Log in to machines as links do, and say what is wrong. Without NAME: all of them."""
    scope = current_scope()
    known = chosen(known_machines(scope, os.environ), names)
    worst, objects = ExitCode.OK, []
    for one in known:
        found: dict[str, object] = {}
        try:
            probe, wrong = check_machine(scope, one)
            found = {**summary(probe.facts, probe.skew)}
        except DoraSystemdError as error:
            wrong = [(error.message, error.hint)]
            worst = ExitCode.NO_HOST
        worst = worst or (ExitCode.FAILURE if wrong else ExitCode.OK)
        problems = [{"problem": reason, "hint": hint} for reason, hint in wrong]
        objects.append({**_object(one), "facts": found or None, "problems": problems})
        if output != "json":
            _print_check(one, found, wrong)
    if output == "json":
        print_json(objects)
    elif not known:
        click.echo(_NONE)
    return worst


@command.command("remove")
@click.argument("name")
@click.option("--force", is_flag=True, help="Forget it here, even if its key stays over there.")
@acting_options
def remove(name: str, force: bool) -> None:
    """Forget the machine NAME, and its key on both sides.

    Without --force nothing is removed if the machine cannot be reached.
    """
    scope = current_scope()
    (machine,) = chosen(known_machines(scope, os.environ), (name,))
    *notes, last = remove_machine(scope, os.environ, machine, force)
    print_warnings(notes)
    tell(last)
    if wants_json():
        print_json([_object(machine)])


def _object(one: Known) -> dict[str, object]:
    return {"machine": one.name, "host": one.host.text, "key": one.key or None}


def _print_check(one: Known, found: dict[str, object], wrong: Sequence[tuple[str, str]]) -> None:
    facts = ", ".join(f"{key} {value}" for key, value in found.items())
    if not wrong:
        click.echo(f"ok       {one.name}: {facts}")
    for reason, hint in wrong:
        click.echo(f"problem  {one.name}: {reason}")
        click.echo(f"         {hint}")

"""Advise settings by what a dataflow has used and how it ended."""

import os

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import check_readable
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.advice.report import format_report, report_object
from dora_systemd.errors import ExitCode
from dora_systemd.verbs.advise import apply, read_advice


@click.command("advise")
@click.argument("selector")
@click.option("--apply", "is_applied", is_flag=True, help="Write it into the settings file.")
@output_option
@scope_options
def command(selector: str, is_applied: bool, output: str) -> int:
    """Advise limits, restarts and times by what the lives in the journal have shown.

    Each advice names its evidence. Nothing is advised below 3 lives in which all nodes became
    ready, or 10 minutes of all together. --apply changes the settings file of the dataflow, and
    keeps its comments and order; the next start has the changes.

    Examples:
      doractl advise robot
      doractl advise robot --apply
      doractl advise robot -o json
    """
    scope = current_scope()
    check_readable(scope)
    report, project = read_advice(Bus(scope, for_reading=True), scope, selector, os.environ)
    if is_applied:
        report = apply(report, project)
    if output == "json":
        print_json(report_object(report))
    else:
        click.echo(format_report(report))
    return ExitCode.OK

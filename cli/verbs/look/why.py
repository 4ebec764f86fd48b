"""Explain what happened to a dataflow and why."""

import json
from pathlib import Path

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.why.report import format_report, report_object
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.verbs.why import explain_now, newest_failure, subject_row


@click.command("why")
@click.argument("selector", required=False)
@click.option("--bundle", "file", metavar="FILE", help="Print the report in a bundle.")
@output_option
@scope_options
def command(selector: str | None, file: str | None, output: str) -> int:
    """Explain what happened to a dataflow and why: what ended, when, which node, what to do.

    The dataflow may be running, failed, stopped, or known only to the journal. Nothing is changed.

    Without a SELECTOR: a degraded dataflow that runs, or else the one that failed last.

    Examples:
      doractl why                   the newest failure
      doractl why robot             what ended it, which node, when, what to do
      doractl why robot -o json     the same for a program
      doractl why 44f30e60          one that ended long ago, by its UUID
      doractl why --bundle FILE     the report in a bundle, on any machine
    """
    if file is not None:
        return _print_bundle(selector, file, output)
    scope = current_scope()
    check_readable(scope)
    bus = Bus(scope, for_reading=True)
    subject = newest_failure(bus, scope) if selector is None else selector
    report = explain_now(bus, scope, subject, JournalReader())
    if output == "json":
        print_json(report_object(report, subject_row(bus, scope, report.subject)))
        return ExitCode.OK
    print_table(lambda width, colors: format_report(report, width, colors))
    return ExitCode.OK


def _print_bundle(selector: str | None, file: str, output: str) -> int:
    """Print the report in a bundle, which may be of another machine, or forged."""
    # Imported late: most explain what this machine knows.
    from dora_systemd.verbs.bundles.listing import parse_why, read_report, shown_readme

    if selector is not None:
        raise usage_error("cannot use both a SELECTOR and --bundle", "doractl why --bundle FILE")
    if not file:  # not the working directory: a variable of a script is not set
        raise usage_error("cannot read '': no path", "doractl why --bundle FILE")
    path = Path(file).absolute()
    readme, why = read_report(path)
    if output == "json":
        click.echo(json.dumps(parse_why(why, path), indent=2))
    else:
        print_table(lambda width, _: shown_readme(readme, width))
    return ExitCode.OK

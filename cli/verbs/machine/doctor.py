"""Check this machine for problems."""

from functools import partial

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import terminal_width
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.views.findings import finding_values, format_findings, has_problem
from dora_systemd.errors import ExitCode
from dora_systemd.verbs.doctor import examine


@click.command("doctor")
@output_option
@scope_options
def command(output: str) -> int:
    """Check everything that dataflows need, and say how to fix what is wrong.

    Changes nothing. The exit status is 1 if a problem keeps dataflows from working; notes and
    warnings do not count.

    Examples:
      doractl doctor
      doractl --user doctor -o json
    """
    findings = examine(partial(Bus, for_reading=True), current_scope())
    if output == "json":
        print_json([finding_values(one) for one in findings])
    else:
        click.echo(format_findings(findings, terminal_width()))
    return ExitCode.FAILURE if has_problem(findings) else ExitCode.OK

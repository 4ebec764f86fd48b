"""doractl start: a dataflow becomes a systemd service."""

import os
import sys
from typing import Any

import click

from dora_systemd.bus import Bus
from dora_systemd.cli.parameters import (
    current_scope,
    name_option,
    output_option,
    print_json,
    print_warnings,
    scope_options,
)
from dora_systemd.cli.settingoptions import setting_options
from dora_systemd.cli.stageline import StageLine
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.managerplan import DEFAULT_FILE, Plan, StartRequest, make_plan, request_name
from dora_systemd.managerstart import format_started, require_free_name, start_plan
from dora_systemd.managerunit import format_plan, plan_properties
from dora_systemd.names import unit_name

_EPILOG = """\b
Examples:
  doractl start                                    ./dataflow.yml
  doractl start dataflow.yml --name robot
  doractl start dataflow.yml --env MODEL=yolov8n.pt --venv .venv
  doractl start dataflow.yml --memory-limit 4G --node-limit detector:memory=1G,cpu=1.5
  doractl start dataflow.yml --property Restart=on-failure
  doractl start dataflow.yml --dry-run
"""


@click.command("start", epilog=_EPILOG)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE]")
@name_option
@setting_options
@click.option("--no-wait", is_flag=True, help="Do not wait until the nodes are ready.")
@click.option("--dry-run", is_flag=True, help="Print the unit and start nothing.")
@output_option
@scope_options
def command(
    dataflow: str, name: str | None, no_wait: bool, dry_run: bool, output: str, **flags: Any
) -> None:
    """Start the dataflow in FILE as the service dora-NAME.service.

    Ends when all nodes are ready, or fails with the reason. The name must be free; a dataflow of
    that name that has failed is replaced, its logs stay.
    """
    scope = current_scope()
    request = StartRequest(dataflow, name, flags, os.environ)
    if dry_run:
        print(format_plan(make_plan(scope, request)), end="")
        return
    bus = Bus(scope)
    require_free_name(bus, unit_name(request_name(request)))
    plan = make_plan(scope, request)
    properties, warnings = plan_properties(plan, bus)
    print_warnings(warnings)
    try:
        with StageLine(sys.stderr) as stage:
            started = start_plan(bus, plan, properties, stage, not no_wait)
    except DoraSystemdError as error:
        if error.code is ExitCode.FAILURE:
            _print_last_words(plan)
        raise
    if output == "json":
        print_json({**vars(started), "dataflow": plan.options.dataflow})
    else:
        click.echo(format_started(started))


def _print_last_words(plan: Plan) -> None:
    # Only a failure pays for the way to the journal.
    from dora_systemd.managerwords import last_words

    for line in last_words(plan.scope, plan.options.uuid):
        click.echo(f"  {line}", err=True)

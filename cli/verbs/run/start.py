"""Start a dataflow as a systemd service."""

import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.foreground import Foreground, print_until_end
from dora_systemd.cli.parameters import (
    current_scope,
    name_option,
    output_option,
    print_json,
    print_warnings,
    scope_options,
)
from dora_systemd.cli.settingoptions import SettingsCommand, setting_options
from dora_systemd.cli.stageline import StageLine
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.facts.last_words import last_words
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.job import Started, format_started, start_plan
from dora_systemd.verbs.start.launch import Claim, claim
from dora_systemd.verbs.start.linger import ensure_linger
from dora_systemd.verbs.start.logins import start_notes
from dora_systemd.verbs.start.plan import DEFAULT_FILE, Plan, StartRequest, make_plan
from dora_systemd.verbs.start.run import HELD
from dora_systemd.verbs.start.unit import format_plan
from dora_systemd.verbs.start.watch import watched_patterns


@click.command("start", cls=SettingsCommand)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE]")
@name_option
@setting_options
@click.option(
    "--attach/--detach",
    "want_logs",
    default=False,
    help="Print its logs until it ends; Ctrl+C stops it then, closing the terminal does not.",
)
@click.option("--no-wait", is_flag=True, help="Do not wait until all nodes are ready.")
@click.option("--enable", "want_boot", is_flag=True, help="Also start it at every boot.")
@click.option("--dry-run", is_flag=True, help="Print the unit and start nothing.")
@output_option
@scope_options
def command(
    dataflow: str,
    name: str | None,
    want_logs: bool,
    no_wait: bool,
    want_boot: bool,
    dry_run: bool,
    output: str,
    **flags: Any,
) -> int:
    """Start the dataflow in FILE as the service dora-NAME.service.

    Returns when all nodes are ready, or fails with the reason. The name must be free; a failed
    dataflow of that name is replaced, its logs stay. An enabled dataflow is started from its unit
    file if its settings are the same; --enable replaces that file.

    Examples:
      doractl start                                    ./dataflow.yml
      doractl start dataflow.yml --name robot
      doractl start dataflow.yml --env MODEL=yolov8n.pt --venv .venv
      doractl start dataflow.yml --memory-limit 4G --node-limit detector:memory=1G,cpu=1.5
      doractl start dataflow.yml --restart-policy on-failure --max-restarts 3
      doractl start dataflow.yml --credential token=/etc/robot/token
      doractl start dataflow.yml --hot-reload --watch "*.py,config/*"
      doractl start dataflow.yml --device /dev/video0 --writable /srv/recordings
      doractl start dataflow.yml --enable              now and at every boot
      doractl start dataflow.yml --attach              with its logs, as doractl run
      doractl start dataflow.yml --dry-run
    """
    if want_logs and (no_wait or output == "json"):
        hint = "leave out --no-wait and --output"
        raise DoraSystemdError("cannot print logs with --no-wait or json", hint, ExitCode.USAGE)
    scope = current_scope()
    request = StartRequest(dataflow, name, flags, os.environ)
    if dry_run:
        target = boot_target(Bus(scope), scope) if want_boot else None
        plan = make_plan(scope, request)
        check_plan(lambda: Bus(scope), plan)
        write_exactly(format_plan(plan, target))
        return ExitCode.OK
    bus = Bus(scope)
    claimed = claim(bus, scope, request, want_boot)
    print_warnings(claimed.warnings)
    print_warnings([ensure_linger(scope) if want_boot else ""])
    notes = [*start_notes(claimed.plan), *claimed.plan.notes]
    if want_logs:
        return _attach(bus, claimed, notes)
    started = _start(bus, claimed, not no_wait)
    # Only after the start: a refusal must be one line and a hint.
    print_warnings(notes)
    if output == "json":
        print_json({**vars(started), "dataflow": claimed.plan.options.dataflow})
    else:
        click.echo(format_started(started, watched_patterns(claimed.plan)))
    return ExitCode.OK


def _attach(bus: Bus, claimed: Claim, notes: Sequence[str]) -> int:
    """Print the logs of the dataflow, which goes on if this process ends."""
    how = Foreground(signals=(signal.SIGINT,), notes=notes)
    # What is started from a unit file stays loaded if it has failed.
    properties = None if claimed.properties is None else [*claimed.properties, HELD]
    return print_until_end(bus, claimed.plan, properties, how)


def _start(bus: Bus, claimed: Claim, wait: bool) -> Started:
    try:
        with StageLine(sys.stderr) as stage:
            return start_plan(bus, claimed.plan, claimed.properties, stage, wait)
    except DoraSystemdError as error:
        if error.code is ExitCode.FAILURE:
            _print_last_words(claimed.plan)
        raise


def _print_last_words(plan: Plan) -> None:
    for line in last_words(plan.scope, plan.options.uuid):
        click.echo(f"  {line}", err=True)

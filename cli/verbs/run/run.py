"""Run a dataflow in the foreground."""

import os
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.foreground import FORMATS, Foreground, print_until_end
from dora_systemd.cli.parameters import (
    current_scope,
    duration_option,
    name_option,
    parsed_by,
    print_warnings,
    scope_options,
)
from dora_systemd.cli.setting_options import SettingsCommand, setting_options
from dora_systemd.decisions.logs.records import DORA_LEVELS, RAW, LogFilter, parse_filter
from dora_systemd.names import unit_name
from dora_systemd.verbs.start.enable import drop_unit_files
from dora_systemd.verbs.start.plan import make_plan
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest, request_name
from dora_systemd.verbs.start.restart_ended import note_start
from dora_systemd.verbs.start.run import attached_properties, life_line
from dora_systemd.verbs.start.start import make_room, refuse_unit_file, require_free_name
from dora_systemd.verbs.start.unit import plan_properties

_USUAL = (
    *("--name", "--stop-after", "--env", "--venv", "--uv"),
    *("--memory-limit", "--cpu-limit", "--device", "--writable", "--hot-reload"),
)


@click.command("run", cls=SettingsCommand, usual=_USUAL)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE]")
@name_option
@duration_option("--stop-after", "Stop it gracefully when it has run so long, such as 30s or 5min.")
@click.option(
    "--log-level",
    type=click.Choice((RAW, *DORA_LEVELS[1:]), case_sensitive=False),
    default=RAW,
    envvar="DORA_LOG_LEVEL",
    show_default=True,
    help="Print this level and above; stdout: everything, also what has no level.",
)
@click.option(
    "--log-filter",
    metavar="NODE=LEVEL,...",
    default="",
    envvar="DORA_LOG_FILTER",
    callback=parsed_by(parse_filter),
    help="Other levels for single nodes.",
)
@click.option(
    "--log-format",
    type=click.Choice(FORMATS),
    default=FORMATS[0],
    envvar="DORA_LOG_FORMAT",
    show_default=True,
    help="Form of the lines; json: one object for each, as dora writes them.",
)
@setting_options
@scope_options
def command(
    dataflow: str,
    name: str | None,
    stop_after: int,
    log_level: str,
    log_filter: dict[str, str],
    log_format: str,
    **flags: Any,
) -> int:
    """Run the dataflow in FILE and print its logs until it ends.

    Ctrl+C stops it gracefully, a second Ctrl+C kills it. The dataflow ends with this command,
    however that ends. The exit status is 0 when all nodes ended well, and 1 when one failed.

    Examples:
      doractl run                          ./dataflow.yml
      doractl run dataflow.yml --name robot --env MODEL=yolov8n.pt
      doractl run dataflow.yml --hot-reload
      doractl run dataflow.yml --stop-after 30s
      doractl run dataflow.yml --log-level warn --log-filter camera=debug
    """
    scope = current_scope()
    request = StartRequest(dataflow, name, flags, os.environ, attached=True)
    bus = Bus(scope)
    boot = require_free_name(bus, scope, unit_name(request_name(request)))
    refuse_unit_file(boot)
    plan = make_plan(scope, request)
    properties, warnings = plan_properties(plan, bus)
    make_room(bus, boot)
    drop_unit_files(bus, boot)
    note_start(plan, request, "doractl run")
    print_warnings(warnings)
    shown = LogFilter(log_level, log_filter)
    how = Foreground(shown, log_format, stop_after=stop_after, notes=plan.notes)
    with life_line() as pipe:
        given = [*properties.values(), *attached_properties(pipe)]
        return print_until_end(bus, plan, given, how)

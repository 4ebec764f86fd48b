"""Run a dataflow in the foreground."""

import os
import sys
import time
from contextlib import closing
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.colors import wants_colors
from dora_systemd.cli.parameters import current_scope, name_option, print_warnings, scope_options
from dora_systemd.cli.settingoptions import SettingsCommand, setting_options
from dora_systemd.cli.stageline import StageLine
from dora_systemd.decisions.logs.terminal import TerminalLines
from dora_systemd.names import unit_name
from dora_systemd.verbs.logs import FollowedLog
from dora_systemd.verbs.start.again import note_start
from dora_systemd.verbs.start.claim import refuse_unit_file, require_free_name
from dora_systemd.verbs.start.enable import drop_unit_files
from dora_systemd.verbs.start.job import start_unit
from dora_systemd.verbs.start.plan import DEFAULT_FILE, StartRequest, make_plan, request_name
from dora_systemd.verbs.start.run import attached_properties, follow_unit, life_line
from dora_systemd.verbs.start.unit import plan_properties

_MICROSECOND_NS = 1000


@click.command("run", cls=SettingsCommand)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE]")
@name_option
@setting_options
@scope_options
def command(dataflow: str, name: str | None, **flags: Any) -> int:
    """Run the dataflow in FILE and print its logs until it ends.

    Ctrl+C stops it gracefully, a second Ctrl+C kills it. The dataflow ends with this command,
    however that ends. The exit status is 0 when all nodes ended well, and 1 when one failed.

    Examples:
      doractl run                          ./dataflow.yml
      doractl run dataflow.yml --name robot --env MODEL=yolov8n.pt
      doractl run dataflow.yml --hot-reload
    """
    scope = current_scope()
    request = StartRequest(dataflow, name, flags, os.environ, attached=True)
    bus = Bus(scope)
    boot = require_free_name(bus, scope, unit_name(request_name(request)))
    refuse_unit_file(boot)
    plan = make_plan(scope, request)
    properties, warnings = plan_properties(plan, bus)
    drop_unit_files(bus, boot)
    note_start(plan, request, "doractl run")
    print_warnings(warnings)
    options = plan.options
    terminal = TerminalLines(want_colors=wants_colors(sys.stdout), is_terminal=sys.stdout.isatty())
    since = time.time_ns() // _MICROSECOND_NS
    with life_line() as pipe, StageLine(sys.stderr) as stage:

        def write(data: bytes) -> None:
            stage.wipe()
            sys.stdout.buffer.write(data)
            sys.stdout.buffer.flush()

        followed = FollowedLog(scope, options.name, options.uuid, since, write, terminal)
        with closing(followed) as logs:
            given = [*properties.values(), *attached_properties(pipe)]
            start_unit(bus, scope, options, given, stage, wait=False)
            return follow_unit(bus, plan.unit, logs, stage)

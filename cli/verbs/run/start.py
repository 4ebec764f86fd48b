"""Start a dataflow as a systemd service."""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, NamedTuple

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    name_option,
    print_outcomes,
    print_warnings,
    wants_json,
)
from dora_systemd.cli.setting_options import SettingsCommand, setting_options
from dora_systemd.cli.terminal import StageLine
from dora_systemd.decisions.settings.resolve import is_given
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.boot import lost_program
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.start.check import check_plan, check_unit
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.logins import ensure_linger, has_run_here, logout_note, start_notes
from dora_systemd.verbs.start.needs import held_notes, waiting_notes
from dora_systemd.verbs.start.plan import make_plan
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest, request_name
from dora_systemd.verbs.start.restart_ended import find_start, means_name
from dora_systemd.verbs.start.start import Claim, claim, require_free_name
from dora_systemd.verbs.start.start_unit import Started, format_started, start_unit
from dora_systemd.verbs.start.unit import format_plan, watched_patterns

_USUAL = (
    *("--name", "--enable", "--attach", "--dry-run", "--env", "--venv", "--memory-limit"),
    *("--cpu-limit", "--restart-policy", "--device", "--writable", "--hot-reload"),
)


class Wanted(NamedTuple):
    """What a start does besides."""

    boot: bool  # enable it
    logs: bool  # print its logs until it ends
    wait: bool  # until all nodes are ready
    push: bool  # first copy its files to all machines


@click.command("start", cls=SettingsCommand, usual=_USUAL)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE|NAME]")
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
@click.option("--push", "want_push", is_flag=True, help="First copy its files to all machines.")
@acting_options
def command(
    dataflow: str,
    name: str | None,
    want_logs: bool,
    no_wait: bool,
    want_boot: bool,
    dry_run: bool,
    want_push: bool,
    **flags: Any,
) -> int:
    """Start the dataflow in FILE as the service dora-NAME.service.

    NAME instead of FILE starts a dataflow that has ended, with the UUID and the settings it had;
    options change these. Returns when all nodes are ready, or fails with the reason.

    The name of a FILE must be free; a failed dataflow of that name is replaced, its logs stay. An
    enabled dataflow is started from its unit file if its settings are the same; --enable replaces
    that file.

    Examples:
      doractl start                           ./dataflow.yml
      doractl start dataflow.yml --name robot
      doractl start dataflow.yml --enable     now and at every boot
      doractl start dataflow.yml --memory-limit 4G --restart-policy on-failure
      doractl start robot                     a dataflow that has ended, again
      doractl start dataflow.yml --env MODEL=yolov8n.pt --venv .venv
      doractl start dataflow.yml --node camera:restart_policy=always,max_restarts=3
      doractl start dataflow.yml --credential token=/etc/robot/token
      doractl start dataflow.yml --hot-reload --watch "*.py,config/*"
      doractl start dataflow.yml --device /dev/video0 --writable /srv/recordings
      doractl start dataflow.yml --attach     with its logs, as doractl run
      doractl start dataflow.yml --dry-run
      doractl start dataflow.yml --push       to all of its machines first
    """
    if want_logs and (no_wait or wants_json()):
        hint = "leave out --no-wait and --output"
        raise usage_error("cannot print logs with --no-wait or json", hint)
    scope = current_scope()
    request = StartRequest(dataflow, name, flags, os.environ)
    if means_name(dataflow):
        bus = Bus(scope)
        is_changed = bool(name or want_boot or dry_run or want_logs or want_push)
        is_changed |= any(map(is_given, flags.values()))
        known = find_start(bus, scope, Selector(dataflow), is_changed)
        if isinstance(known, Cell):
            return _start_known(bus, scope, known, not no_wait)
        request = known.request(request)
    if dry_run:
        return _print_unit(scope, request, want_boot)
    return _start(scope, request, Wanted(want_boot, want_logs, not no_wait, want_push))


def _print_unit(scope: Scope, request: StartRequest, want_boot: bool) -> ExitCode:
    connect = cache(partial(Bus, scope))
    target = boot_target(connect(), scope) if want_boot else None
    plan = make_plan(scope, request)
    check_plan(connect, plan)
    check_unit(connect, plan)
    write_exactly(format_plan(plan, connect, target))
    return ExitCode.OK


def _start(scope: Scope, request: StartRequest, want: Wanted) -> int:
    bus = Bus(scope)
    if want.push:
        _push(bus, scope, request)
    claimed = claim(bus, scope, request, "doractl start", want.boot)
    print_warnings(claimed.warnings)
    print_warnings([ensure_linger(scope) if want.boot else ""])
    logins = () if has_run_here(scope) else start_notes(claimed.plan)
    notes = [*claimed.plan.notes, *logins, "" if want.boot else logout_note(scope)]
    if want.logs:
        return _attach(bus, claimed, notes)
    options = claimed.plan.options
    with _last_words(bus, scope, options.uuid), StageLine(sys.stderr) as stage:
        how = (claimed.properties, stage, want.wait, claimed.links)
        started = start_unit(bus, scope, options, *how)
    status = _print_started(started, options.dataflow, watched_patterns(claimed.plan))
    # Only after the start: a refusal must be one line and a hint.
    print_warnings([*notes, *waiting_notes(bus, options)])
    print_warnings(() if want.wait else held_notes(bus, options.name))
    return status


def _push(bus: Bus, scope: Scope, request: StartRequest) -> None:
    """Copy the files to the other machines, unless the start would be refused before that."""
    from dora_systemd.verbs.machines.push import push

    require_free_name(bus, scope, unit_name(request_name(request)))
    with StageLine(sys.stderr) as stage:
        push(make_plan(scope, request), stage)


def _attach(bus: Bus, claimed: Claim, notes: Sequence[str]) -> int:
    """Print the logs of the dataflow, which keeps running if this process ends."""
    from dora_systemd.cli.foreground import Foreground, print_until_end
    from dora_systemd.verbs.start.run import HELD

    how = Foreground(
        signals=(signal.SIGINT,),
        notes=notes,
        command="doractl start --attach",
        links=claimed.links,
    )
    # What is started from a unit file stays loaded if it has failed.
    properties = None if claimed.properties is None else [*claimed.properties, HELD]
    return print_until_end(bus, claimed.plan, properties, how)


def _start_known(bus: Bus, scope: Scope, cell: Cell, wait: bool) -> ExitCode:
    """Start a loaded unit as systemctl start does: a running dataflow keeps running.

    Raises DoraSystemdError (NAME_IN_USE) for one that is about to end.
    """
    file = cell.options.dataflow
    if cell.state.active == "deactivating":
        message, hint = f"cannot start {cell.name}: it is stopping", f"doractl list {cell.name}"
        raise DoraSystemdError(message, f"{hint} shows what it waits for", ExitCode.NAME_IN_USE)
    if cell.has_begun:
        details = {"file": file, "is_ready": cell.state.active == "active"}
        return print_outcomes([Outcome(cell, format_up(cell), is_news=False, details=details)])
    commands = bus.read(cell.unit, ["ExecStart"])["ExecStart"]
    if error := lost_program(bus, scope, cell, commands, "start"):
        raise error
    bus.hold(cell.unit)  # keep a failed transient unit
    bus.reset_failed(cell.unit)
    note = logout_note(scope)
    with _last_words(bus, scope, cell.uuid), StageLine(sys.stderr) as stage:
        started = start_unit(bus, scope, cell.options, None, stage, wait)
    print_warnings([note, *waiting_notes(bus, cell.options)])
    print_warnings(() if wait else held_notes(bus, cell.name))
    return _print_started(started, file, ())


def format_up(cell: Cell) -> str:
    """Format the answer to a start of a dataflow that need not be started."""
    if cell.awaits_restart:
        now = f"doractl restart {cell.name} starts it now"
        return f"Dataflow waiting for its restart: {cell.uuid} ({cell.name}; {now})"
    return f"Dataflow already running: {cell.uuid} ({cell.name})"


def _print_started(started: Started, file: str, watched: Sequence[str]) -> ExitCode:
    details = {"file": file, "is_ready": started.is_ready}
    return print_outcomes([Outcome(started, format_started(started, watched), details=details)])


@contextmanager
def _last_words(bus: Bus, scope: Scope, uuid: str) -> Iterator[None]:
    """Add the last lines of the nodes to the error if the context fails to start the dataflow."""
    try:
        yield
    except DoraSystemdError as error:
        from dora_systemd.cli.verbs.run.restart import with_last_lines

        raise with_last_lines(bus, scope, uuid, error) from error

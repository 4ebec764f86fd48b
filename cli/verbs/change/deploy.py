"""Copy a project into a release and run that, or what ran before."""

import os
import sys
from functools import partial
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.releases.transfer import Stream
from dora_systemd.cli.inhibit_options import if_inhibited, inhibit_options
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    duration_option,
    name_option,
    print_json,
    print_outcomes,
    refuse_serial,
    serial_option,
    tell,
    waiting_option,
    wants_json,
)
from dora_systemd.cli.progress import open_progress, quiet_option
from dora_systemd.cli.setting_options import SettingsCommand, setting_options
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.deploy import Deployed, DeployRequest, compare, deploy
from dora_systemd.verbs.releases.receive import compare_sent, receive
from dora_systemd.verbs.start.logins import ensure_linger, logout_note
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest

_INPUT = 0
_SIGNS = {"added": "+", "changed": "~", "removed": "-"}


_USUAL = (
    *("--name", "--soak", "--dry-run", "--no-build", "--no-enable", "--force", "--venv"),
    *("--memory-limit", "--restart-policy", "--writable", "-H"),
)


@click.command("deploy", cls=SettingsCommand, usual=_USUAL)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE|DIR]")
@name_option
@setting_options
@duration_option(
    "--soak", "Time without a fault that the release has to pass; default: 30s.", "30s"
)
@click.option(
    "--keep",
    type=click.IntRange(min=1),
    metavar="N",
    default=5,
    help="Releases to keep; the present one and the one that ran well before stay; default: 5.",
)
@duration_option("--build-timeout", "Time that its build may take; default: 30min.", "30min")
@click.option("--no-build", is_flag=True, help="Do not build; deploy what the project has.")
@waiting_option
@click.option("--no-enable", is_flag=True, help="Do not start it at every boot.")
@serial_option
@click.option("--from-stdin", is_flag=True, help="Read what deploy -H of another host sends.")
@click.option("--dry-run", is_flag=True, help="Print what would change, and change nothing.")
@quiet_option
@partial(inhibit_options, or_else=", or nothing has changed")
@acting_options
def command(
    dataflow: str,
    name: str | None,
    soak: int,
    keep: int,
    build_timeout: int,
    no_build: bool,
    allow_waiting: bool,
    no_enable: bool,
    serial: int,
    from_stdin: bool,
    dry_run: bool,
    is_quiet: bool,
    force: bool,
    wait: bool,
    **flags: Any,
) -> int:
    """Copy the project of FILE, or of DIR, into a release that does not change, and run it.

    Nodes with build or git are built first, as the user of the nodes.

    The release is on trial until all nodes are ready and no node has failed for a while. Then it is
    what every start and boot runs. If it fails, what ran before runs again, and the exit status is
    11. A reboot during the trial boots what ran before. Refused while a lock inhibits it.

    If neither the project nor a setting has changed since the release that runs, that runs on.

    With -H, FILE is a project here: each host gets it by ssh, one after the other, until a host has
    rolled it back.

    Examples:
      doractl deploy --name robot             the project in this directory
      doractl deploy /srv/robot --soak 5min
      doractl deploy flows/robot.yml --memory-limit 4G --restart-policy on-failure
      doractl deploy --dry-run                files that differ from the last one
      doractl -H base,arm deploy /srv/robot   one host after the other
    """
    refuse_serial(serial)
    if not build_timeout:
        hint = "write a time such as 30min, or --no-build"
        raise usage_error("cannot use 0 as --build-timeout", hint)
    scope = current_scope()
    start = StartRequest(dataflow, name, flags, os.environ)
    bus = Bus(scope)
    if dry_run:
        return _print_changes(bus, scope, start, not no_build, from_stdin, is_quiet)
    how, build_timeout = if_inhibited(force, wait), 0 if no_build else build_timeout
    request = DeployRequest(start, soak, keep, not no_enable, how, build_timeout, allow_waiting)
    done = _deploy(bus, scope, request, from_stdin, is_quiet)
    return print_outcomes([] if is_quiet else [deployed_outcome(done, "deployed")])


def _deploy(
    bus: Bus, scope: Scope, request: DeployRequest, from_stdin: bool, is_quiet: bool
) -> Deployed:
    note = logout_note(scope)
    with open_progress(is_quiet) as progress:
        warn = progress.warn
        if from_stdin:
            done = receive(bus, scope, request, Stream(_INPUT), _answer, progress, warn)
        else:
            done = deploy(bus, scope, request, progress, warn)
    progress.warn(ensure_linger(scope) if request.want_boot else note)
    return done


def _answer(line: str) -> None:
    click.echo(line)
    sys.stdout.flush()


def deployed_outcome(done: Deployed, how: str) -> Outcome:
    """Return the outcome for a release that runs. how: "deployed" or "rolled back"."""
    details = {"release": done.release or None, "former": done.former or None, "files": done.files}
    details |= {"size_bytes": done.size, "copied_bytes": done.copied}
    if done.is_unchanged:
        text = f"unchanged: release {done.release} runs"
        return Outcome(done, text, is_news=False, details=details)
    lines = [
        f"Dataflow {how}: {done.uuid} ({done.name})",
        f"Release: {done.release or 'none, its trial has ended'}",
    ]
    lines += [f"Before: {done.former}"] if done.former else []
    return Outcome(done, "\n".join([*lines, f"Unit: {done.unit}"]), details=details)


def _print_changes(
    bus: Bus, scope: Scope, start: StartRequest, want_build: bool, from_stdin: bool, is_quiet: bool
) -> int:
    if from_stdin:
        last, changes = compare_sent(bus, scope, Stream(_INPUT))
    else:
        last, changes = compare(bus, scope, start, want_build)
    if is_quiet:
        return ExitCode.OK
    if wants_json():
        print_json({"release": last or None, **changes})
        return ExitCode.OK
    for what, paths in changes.items():
        for path in paths:
            tell(f"{_SIGNS[what]} {path}")
    if not any(changes.values()):
        tell(f"Nothing differs from release {last}")
    return ExitCode.OK

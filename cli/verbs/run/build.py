"""Build the nodes of a dataflow."""

import os
import shlex
from functools import partial
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes, wants_json
from dora_systemd.cli.setting_options import SettingsCommand, options_of
from dora_systemd.decisions.views.outcome import Outcome, Thing
from dora_systemd.scope import scope_of
from dora_systemd.verbs.build import SETTINGS, Project, build
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest


@click.command("build", cls=SettingsCommand)
@click.argument("dataflow", default=DEFAULT_FILE, metavar="[FILE]")
@partial(options_of, SETTINGS)
@acting_options
def command(dataflow: str, **flags: Any) -> int:
    """Build the nodes of the dataflow in FILE where they are, before a start.

    Runs uv sync if the project has a uv.lock, then dora build. The owner of FILE builds, and never
    root: as root, choose another user with --uid. Ctrl+C ends the build.

    Examples:
      doractl build                           ./dataflow.yml
      doractl build dataflow.yml --uv         build: pip install ... by uv
      doractl build /home/alice/robot/dataflow.yml
      doractl -H base build /srv/robot/dataflow.yml
    """
    request = StartRequest(dataflow, None, flags, os.environ)
    is_error = wants_json()
    reach = partial(Bus, scope_of(is_user=False))
    show = partial(click.echo, nl=False, err=is_error)
    built = build(reach, current_scope(), request, show)
    return print_outcomes([_outcome(built, dataflow)])


def _outcome(built: Project, given: str) -> Outcome:
    file = shlex.quote(given)
    start = "doractl start" if given == DEFAULT_FILE else f"doractl start {file}"
    details = {"file": built.dataflow, "user": built.user or None, "has_lock": bool(built.lock)}
    text = f"Dataflow built: {built.dataflow}\nUse '{start}' to start"
    return Outcome(Thing(), text, details=details)

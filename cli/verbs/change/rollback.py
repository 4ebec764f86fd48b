"""Run an older release again."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.inhibit_options import if_inhibited, inhibit_options
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    duration_option,
    print_outcomes,
    refuse_serial,
    serial_option,
    waiting_option,
)
from dora_systemd.cli.progress import open_progress, quiet_option
from dora_systemd.cli.verbs.change.deploy import deployed_outcome
from dora_systemd.verbs.releases.rollback import roll_back


@click.command("rollback")
@click.argument("selector")
@click.argument("release", required=False, metavar="[RELEASE]")
@duration_option("--soak", "Time without a fault that the release has to pass; default: 0s.", "0s")
@waiting_option
@serial_option
@quiet_option
@inhibit_options
@acting_options
def command(
    selector: str,
    release: str | None,
    soak: int,
    allow_waiting: bool,
    serial: int,
    is_quiet: bool,
    force: bool,
    wait: bool,
) -> int:
    """Run an older release of a dataflow: the one that ran well before this one, or RELEASE.

    Without RELEASE, it is never one that failed its trial or that a rollback has gone back from.

    It is on trial until all its nodes are ready. If it fails, what ran before runs again, and the
    exit status is 11. Refused while a lock inhibits it.

    Examples:
      doractl rollback robot
      doractl rollback robot 20261121T220012-9f3c1a2
    """
    refuse_serial(serial)
    how = if_inhibited(force, wait)
    scope = current_scope()
    with open_progress(is_quiet) as progress:
        bus, may_wait = Bus(scope), allow_waiting
        done = roll_back(bus, scope, selector, release, soak, progress, how, may_wait=may_wait)
    return print_outcomes([] if is_quiet else [deployed_outcome(done, "rolled back")])

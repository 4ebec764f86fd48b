"""Remove releases, or all that is kept of a dataflow."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import acting_options, can_ask, current_scope, print_outcomes
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.values import counted
from dora_systemd.verbs.releases.forget import Kept, find_kept, forget, remove_releases


@click.command("forget")
@click.argument("selector")
@click.argument("releases", nargs=-1, metavar="[RELEASE]...")
@click.option("--force", is_flag=True, help="Do not prompt; required without a terminal.")
@acting_options
def command(selector: str, releases: tuple[str, ...], force: bool) -> int:
    """Remove all that is kept of a dataflow: its releases, their history, its place in list --all.

    With RELEASE, only these releases. What runs, is enabled or on trial is refused. The project and
    the lines in the journal stay.

    Examples:
      doractl forget robot                        asks first
      doractl forget robot 20261121T220012-9f3c1a2
    """
    scope = current_scope()
    bus = Bus(scope)
    if releases:
        done = remove_releases(bus, scope, selector, releases)
        return print_outcomes(_removed(kept, one) for kept, one in done)
    kept = find_kept(bus, scope, selector)
    if not (force or _agrees(kept)):
        raise DoraSystemdError("nothing was removed", "--force removes it without a question")
    forget(bus, scope, kept)
    details = {"releases": list(kept.releases)}
    text = f"Dataflow forgotten: {kept.uuid or '-'} ({kept.name}), {_count(kept)}"
    return print_outcomes([Outcome(kept, text, details=details)])


def _removed(kept: Kept, release: str) -> Outcome:
    return Outcome(kept, f"Release removed: {release} ({kept.name})", details={"release": release})


def _agrees(kept: Kept) -> bool:
    """Ask at the terminal for a confirmation. Raises DoraSystemdError (USAGE) without terminal."""
    if not can_ask():
        raise usage_error(
            f"cannot forget {kept.name}: the question needs a terminal", "use --force"
        )
    what = f"{kept.name} and its {_count(kept)}" if kept.releases else kept.name
    return click.confirm(f"Forget {what} for good?", err=True)


def _count(kept: Kept) -> str:
    return counted(len(kept.releases), "release")

"""Install units, completions and manuals after pip install."""

from collections.abc import Sequence

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    print_warnings,
    tell,
)
from dora_systemd.decisions.views.outcome import Outcome, Thing
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.destroy import stop_gateway_of
from dora_systemd.verbs.setup import (
    Step,
    leave_no_state,
    packaged_unit,
    plan_setup,
    put_in_place,
    refuse_if_needed,
    take_away,
    tell_systemd,
    unsearched,
)


@click.command("setup")
@click.option(
    "--remove", "want_removal", is_flag=True, help="Remove everything that setup has installed."
)
@acting_options
def command(want_removal: bool) -> int:
    """Install dora.slice, dora.target, catalog, completions and manuals after pip install.

    Below /usr/local for the system, below ~/.local/share for a user; the Debian package contains
    all of it. A file of the same name that is not from dora-systemd is refused and not touched.

    Examples:
      doractl setup
      doractl setup --user
      doractl setup --remove
    """
    scope = current_scope()
    if not want_removal and (packaged := packaged_unit(scope)):
        return _nothing(f"Everything is installed by a package: {packaged}")
    steps = plan_setup(scope)
    if want_removal:
        refuse_if_needed(Bus, scope)
        _close_gateway(scope, steps)
    changed = take_away(steps) if want_removal else put_in_place(steps)
    if not changed and want_removal:
        return _nothing("Nothing to remove.")
    if not changed:
        print_warnings(tell_systemd(Bus, scope))  # the user dora may be gone
        print_warnings(unsearched(Bus, scope))
        return _nothing("Everything is installed.")
    word = "Removed" if want_removal else "Installed"
    status = print_outcomes(
        Outcome(Thing(), f"{word}: {path}", details={"path": str(path)}) for path in changed
    )
    print_warnings(tell_systemd(Bus, scope, () if want_removal else changed))
    if want_removal:
        leave_no_state(scope)
    else:
        print_warnings(unsearched(Bus, scope))
    return status


def _nothing(text: str) -> int:
    return print_outcomes([Outcome(Thing(), text, is_news=False)])


def _close_gateway(scope: Scope, steps: Sequence[Step]) -> None:
    """Stop the gateway while systemd has its units; without systemd it does not run."""
    try:
        bus = Bus(scope)
    except DoraSystemdError:
        return
    if stop_gateway_of(bus, scope, [step.path for step in steps if step.present is not None]):
        tell("Gateway stopped")

"""Change limits or hot reload of a running dataflow."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    print_warnings,
)
from dora_systemd.cli.setting_options import options_of
from dora_systemd.decisions.settings.resolve import is_given
from dora_systemd.decisions.settings.table import CHANGEABLE
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.releases.listing import refuse_on_trial
from dora_systemd.verbs.reload import (
    check_hot_reload,
    checked_record,
    switch_hot_reload,
    switch_record,
)
from dora_systemd.verbs.set import set_limits


@click.command("set")
@click.argument("selector")
@partial(options_of, CHANGEABLE)
@click.option("--hot-reload", type=click.Choice(["on", "off"]), help="Turn hot reload on or off.")
@click.option(
    "--record",
    metavar="last=TIME,memory=SIZE,...",
    help="What the recorder keeps from now on; off gives its memory back.",
)
@click.option("--force", is_flag=True, help="Set a limit below the current usage, too.")
@acting_options
def command(
    selector: str, hot_reload: str | None, record: str | None, force: bool, **flags: Any
) -> int:
    """Change limits, hot reload or the recorder of a running dataflow.

    Changes take effect at once and survive restarts, until the dataflow is stopped; those of an
    enabled dataflow, until it is disabled: if it does not run, its next start has new limits.
    infinity removes a limit. If one change is invalid, nothing is changed.

    Examples:
      doractl set robot --memory-limit 6G
      doractl set robot --node detector:memory_limit=2G,cpu_limit=1.5
      doractl set robot --cpu-limit infinity
      doractl set robot --node camera:log_rate_limit=10/1s
      doractl set robot --hot-reload on
      doractl set robot --record off
    """
    scope = current_scope()
    bus = Bus(scope)
    cell = Selector(selector).find_present(bus, scope)
    refuse_on_trial(scope, cell, "set")
    if hot_reload is not None:
        check_hot_reload(cell, hot_reload == "on")
    if record is not None:
        checked_record(cell, record)
    done = _changes(bus, scope, cell, hot_reload, record, flags, force)
    return print_outcomes(Outcome(cell, f"{one}: {cell.uuid} ({cell.name})") for one in done)


def _changes(
    bus: Bus,
    scope: Scope,
    cell: Cell,
    hot_reload: str | None,
    record: str | None,
    flags: dict[str, Any],
    force: bool,
) -> Iterator[str]:
    """Make each change, then yield it."""
    warnings: list[str] = []

    def switch() -> None:
        if record is not None:
            warnings.extend(switch_record(bus, scope, cell, record))

    if (hot_reload is None and record is None) or any(map(is_given, flags.values())):
        # The runner may refuse what is to be recorded: then the limits stay, too.
        print_warnings(set_limits(bus, scope, cell, flags, force, first=switch))
        yield "Limits changed" if cell.has_begun else "Limits changed for the next start"
    else:
        switch()
    if hot_reload is not None:
        switch_hot_reload(bus, scope, cell, hot_reload == "on")
        yield f"Hot reload {hot_reload}"
    if record is not None:
        print_warnings(warnings)
        yield "Recorder changed"

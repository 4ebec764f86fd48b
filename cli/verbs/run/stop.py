"""Stop dataflows."""

import sys
from collections.abc import Sequence
from functools import partial

import click

from dora_systemd.adapters.bus.manager import tell_stage
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    can_ask,
    current_scope,
    duration_option,
    print_outcomes,
    require_names_or_all,
    tell,
)
from dora_systemd.cli.terminal import StageLine
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.views.inhibitors import format_holders
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells, refuse_parts, without_parts
from dora_systemd.verbs.facts.locks import read_holders
from dora_systemd.verbs.facts.selector import Selector, selectors_of
from dora_systemd.verbs.stop import (
    find_dependents,
    format_dependents,
    not_running,
    note_stop,
    stop_cells,
    stop_cells_within,
)


@click.command("stop")
@click.argument("selectors", nargs=-1, metavar="[SELECTOR...]")
@click.option("-n", "--name", metavar="NAME", help="The same as SELECTOR, as in dora stop.")
@click.option("-a", "--all", "want_all", is_flag=True, help="All dataflows that run.")
@duration_option(
    "--grace-duration",
    "Kill what still runs after 1.5 times this, if that is sooner than the dataflow's own.",
)
@click.option("-f", "--force", "--now", "force", is_flag=True, help="Kill the nodes at once.")
@acting_options
def command(
    selectors: tuple[str, ...], name: str | None, want_all: bool, grace_duration: int, force: bool
) -> int:
    """Stop dataflows and wait until they have ended.

    Nodes are told to stop; those still running after the grace duration of the dataflow are
    killed. Several dataflows stop at the same time. Those that need one of them stop with it. On a
    terminal it asks before that, and before it stops one that doractl inhibit or a node inhibits.
    Without SELECTOR, a terminal is asked which one; the only one that runs is stopped.

    A node with a `stop` in the settings has a time of its own, and may stop after others. Then one
    Ctrl+C does not end the wait, and a second one kills what still runs, as --now does.

    Examples:
      doractl stop                                the one that runs, or asks
      doractl stop robot
      doractl stop 550e8400 vision
      doractl stop 'cam*' --grace-duration 2s
      doractl stop robot --now
      doractl stop --all
    """
    if force and grace_duration != INFINITY:
        raise usage_error("cannot use --force with --grace-duration", "give one of them")
    most = 0 if force else min(kill_delay(grace_duration), INFINITY)
    texts = (*selectors, *([name] if name else []))
    if texts or want_all or not can_ask():
        require_names_or_all("stop", texts, want_all)
    scope = current_scope()
    bus = Bus(scope)
    cells = read_cells(bus)
    chosen = _named(scope, cells, texts) if texts else _running(cells, want_all)
    found = proven(chosen)
    return _stop(bus, scope, without_parts(found) if want_all else found, most)


def _running(cells: Sequence[Cell], want_all: bool) -> list[Cell]:
    """Return all dataflows that run, or the one that the user chooses."""
    up = [cell for cell in cells if cell.is_up]
    if not up:
        tell("No dataflow is running.")
    return up if want_all or len(up) <= 1 else [_asked(up)]


def _named(scope: Scope, cells: Sequence[Cell], texts: Sequence[str]) -> list[Cell]:
    """The dataflows to stop; prints those that have ended."""
    found = {one: one.proven(cells) for one in selectors_of(texts, cells)}
    for one in [one for one, cell in found.items() if cell is None]:
        row = one.ended(scope)
        if row is None:
            raise one.missing(cell.name for cell in cells)
        print_outcomes([not_running(row, row.status.lower())])
    return list(dict.fromkeys(cell for cell in found.values() if cell))


def _asked(cells: Sequence[Cell]) -> Cell:
    """The dataflow that the user chooses on the terminal."""
    click.echo("Which dataflow is to be stopped?", err=True)
    for number, cell in enumerate(cells, 1):
        click.echo(f"{number:3}  {cell.name}  {cell.uuid}", err=True)
    text = str(click.prompt("Number or name", err=True)).strip()
    numbers = {str(number): cell for number, cell in enumerate(cells, 1)}
    return numbers.get(text) or Selector(text).loaded(cells)


def _ask_dependents(cells: Sequence[Cell], dependents: Sequence[Cell]) -> None:
    """Ask at the terminal before other dataflows stop that need `cells`."""
    if not dependents:
        return
    click.echo(format_dependents(cells, dependents), err=True)
    names = ", ".join(cell.name for cell in [*cells, *dependents])
    if not click.confirm(f"Stop {names}?", err=True):
        raise DoraSystemdError("nothing was stopped", "--force kills all of them at once")


def _ask_inhibited(scope: Scope, cells: Sequence[Cell]) -> None:
    """Ask at the terminal before a dataflow with inhibited restarts stops."""
    for name, holders in read_holders(scope, [cell.name for cell in cells if cell.is_up]).items():
        click.echo(f"{name} is inhibited by {format_holders(holders)}", err=True)
        if not click.confirm(f"Stop {name} anyway?", err=True):
            hint = "--force kills it at once, without a question"
            raise DoraSystemdError(f"{name} was not stopped", hint, ExitCode.INHIBITED)


def _stop(bus: Bus, scope: Scope, cells: list[Cell], most: int) -> int:
    refuse_parts(cells, "stop")
    dependents = find_dependents(bus, cells)
    if most > 0 and can_ask():
        _ask_dependents(cells, dependents)
        _ask_inhibited(scope, [*cells, *dependents])
    elif dependents:
        tell(f"doractl: {format_dependents(cells, dependents)}", err=True)
    note_stop(cells)
    note_stop(dependents, f"doractl stop {' '.join(cell.name for cell in cells)}")
    cells = [*cells, *dependents]
    if most != INFINITY:
        return print_outcomes(stop_cells_within(bus, scope, cells, most))
    try:
        outcomes = _wait(bus, scope, cells)
    except KeyboardInterrupt as error:
        if not any(one.known_options and one.known_options.by_node("stop") for one in cells):
            raise _interruption(cells) from error
        outcomes = _wait_on(scope, cells)
    return print_outcomes(outcomes)


def _interruption(cells: Sequence[Cell]) -> DoraSystemdError:
    names = " ".join(cell.name for cell in cells)
    hint = f"doractl stop {names} waits again, with --now it kills what still runs"
    return DoraSystemdError(
        f"interrupted; the stop of {names} continues", hint, ExitCode.INTERRUPTED
    )


def _wait(bus: Bus, scope: Scope, cells: Sequence[Cell]) -> list[Outcome]:
    with StageLine(sys.stderr, is_stop=True) as stage:
        return stop_cells(bus, scope, cells, partial(tell_stage, stage))


def _wait_on(scope: Scope, cells: Sequence[Cell]) -> list[Outcome]:
    """Wait for a stop that may save data; kill what still runs after another Ctrl+C."""
    try:
        tell("doractl: the stop continues; Ctrl+C again kills the nodes that still run", err=True)
        return _wait(Bus(scope), scope, cells)
    except KeyboardInterrupt:
        return stop_cells_within(Bus(scope), scope, cells, 0)

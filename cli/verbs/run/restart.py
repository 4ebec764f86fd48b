"""Restart dataflows."""

import os
import sys
from functools import partial

import click

from dora_systemd.adapters.bus.manager import Manager, tell_stage
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.inhibit_options import TellWaiting, if_inhibited, inhibit_options
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    print_warnings,
    tell,
)
from dora_systemd.cli.terminal import StageLine
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import refuse_parts
from dora_systemd.verbs.facts.locks import uninhibited
from dora_systemd.verbs.restart import restart_cells
from dora_systemd.verbs.start.programs import version_warnings
from dora_systemd.verbs.start.restart_ended import find_known
from dora_systemd.verbs.stop import find_dependents, format_dependents


@click.command("restart")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@partial(inhibit_options, or_else=", or its files could not start")
@acting_options
def command(selectors: tuple[str, ...], force: bool, wait: bool) -> int:
    """Restart dataflows and wait until all their nodes are ready again.

    Name, UUID and settings stay; the dataflow file is read again. A dataflow that has failed or
    ended is started again. Refused while doractl inhibit or a node inhibits it, and for a dataflow
    whose files could not start; it keeps running then.

    Examples:
      doractl restart robot
      doractl restart robot vision
    """
    how = if_inhibited(force, wait)
    scope = current_scope()
    bus = Bus(scope)
    cells, ended = find_known(bus, scope, selectors)
    refuse_parts(cells, "restart")
    if dependents := find_dependents(bus, cells):  # systemd restarts them in any case
        tell(f"doractl: {format_dependents(cells, dependents)}", err=True)
        cells += dependents
    with uninhibited(scope, cells, "restart", how, TellWaiting()), StageLine(sys.stderr) as stage:
        observer = partial(tell_stage, stage)
        outcomes = restart_cells(bus, scope, cells, "doractl restart", force, observer)
        if ended:
            from dora_systemd.verbs.start.start import restart_asked

            given = (os.environ, stage, "doractl restart")
            outcomes += [restart_asked(bus, scope, one, *given) for one in ended]
    done = [cell for cell, one in zip(cells, outcomes, strict=False) if not one.problem]
    print_warnings(version_warnings(bus, done))
    if any(one.problem for one in outcomes):
        return print_outcomes(with_last_words(bus, scope, one) for one in outcomes)
    return print_outcomes(outcomes)


def with_last_lines(
    manager: Manager, scope: Scope, uuid: str, error: DoraSystemdError
) -> DoraSystemdError:
    """The error of a start with the last lines of the nodes, and the hint for these."""
    if error.code is not ExitCode.FAILURE:
        return error
    # Imported late: most starts succeed.
    from dora_systemd.decisions.why.remedies import known_remedy
    from dora_systemd.verbs.why import words_of_start

    words = words_of_start(manager, scope, uuid)
    hint = known_remedy(words) or error.hint
    return DoraSystemdError(error.message, hint, error.code, words)


def with_last_words(manager: Manager, scope: Scope, outcome: Outcome) -> Outcome:
    """The outcome of a restart; if it has failed, with the last lines of the nodes."""
    if outcome.error is None:
        return outcome
    error = with_last_lines(manager, scope, outcome.subject.uuid, outcome.error)
    return outcome._replace(hint=error.hint, lines=error.lines)

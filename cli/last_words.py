"""Prints what the nodes of a dataflow wrote last, if it has failed to start."""

from dataclasses import replace

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import tell
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.decisions.why.remedies import known_remedy
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.why import words_of_start


def print_last_words(bus: Bus, scope: Scope, uuid: str, error: DoraSystemdError) -> str:
    """Print the lines before the error of a start; the hint for the error."""
    if error.code is not ExitCode.FAILURE:
        return error.hint
    words = words_of_start(bus, scope, uuid)
    for line in words:
        tell(f"  {line}", err=True)
    return known_remedy(words) or error.hint


def with_last_words(bus: Bus, scope: Scope, outcome: Outcome) -> Outcome:
    """The outcome of a restart; if it has failed, print the lines before it."""
    if outcome.error is None:
        return outcome
    hint = print_last_words(bus, scope, outcome.subject.uuid, outcome.error)
    return replace(outcome, hint=hint)

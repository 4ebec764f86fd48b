"""What other verbs may not do to a dataflow while a release of it is on trial."""

from dora_systemd.adapters.releases.store import is_locked
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import release_of
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.releases.listing import store_of
from dora_systemd.verbs.releases.trial import trial_options


def refuse_on_trial(scope: Scope, cell: Cell, verb: str) -> None:
    """Raise DoraSystemdError if a deploy or rollback tries a release of the dataflow now.

    What it commits, or goes back to, would undo half of what `verb` does to the unit.
    """
    options = trial_options(scope, cell.unit)
    if options and is_locked(store_of(scope, cell.name)):
        raise DoraSystemdError(
            f"cannot {verb} {cell.name}: release {release_of(options.dataflow)} is on trial",
            f"wait until that has ended; doractl releases {cell.name} shows it",
        )

"""`doractl releases`: the releases in the store, and which of them runs."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.store import HISTORY, Store, is_locked, store_root
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.releases.past import (
    UNKNOWN,
    UNPROVED,
    Known,
    Switch,
    begins,
    ends,
    marks,
    state_of,
)
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.views.releases import ReleaseRow
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_name, release_of, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import counted
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.releases.trial import (
    Standing,
    read_past,
    read_standing,
    remains,
    trial_options,
)

_MOST_NAMES = 10_000


def root_of(scope: Scope) -> Path:
    """The directory of the releases of all dataflows."""
    return store_root(scope.state_root)


def store_of(scope: Scope, name: str) -> Store:
    """The releases of a dataflow."""
    return Store(root_of(scope), name)


def deployed_names(scope: Scope) -> list[str]:
    """The dataflows that have releases, sorted."""
    with suppress(OSError):
        return [name for name in list_directory(root_of(scope), _MOST_NAMES) if is_name(name)]
    return []


def read_releases(manager: Manager, scope: Scope, names: Sequence[str]) -> list[ReleaseRow]:
    """Read all releases of these dataflows, the newest of each first.

    Of several dataflows, one whose unit is not ours has releases in an unknown state. Raises
    DoraSystemdError (NAME_IN_USE) for a single one.
    """
    rows = []
    for name in names:
        store = store_of(scope, name)
        standing: Standing | None = None
        try:
            standing = read_standing(manager, scope, unit_name(name))
        except DoraSystemdError:
            if len(names) == 1:
                raise
        past: list[Switch] = []
        with suppress(DoraSystemdError):  # only its owner may read it
            past = read_past(store, standing.current if standing else "")
        rows += [_row(store, standing, one, past) for one in reversed(store.known())]
    return rows


def read_history(manager: Manager, scope: Scope, name: str) -> list[Switch]:
    """Read the changes of a dataflow's release, newest first.

    Raises DoraSystemdError, with NO_PERMISSION for another user's releases.
    """
    current = read_standing(manager, scope, unit_name(name)).current
    try:
        return read_past(store_of(scope, name), current)[::-1]
    except DoraSystemdError as error:
        if not error.is_refused:
            raise
        raise DoraSystemdError(error.message, "use sudo", ExitCode.NO_PERMISSION) from error


def _row(store: Store, standing: Standing | None, one: Known, past: Sequence[Switch]) -> ReleaseRow:
    manifest: Manifest | None = None
    with suppress(DoraSystemdError):  # others than root may not look into it
        manifest = store.manifest(one.id)
    mark, end = marks(past).get(one.id), ends(past).get(one.id)
    state = state_of(one, standing.current, standing.trial, mark) if standing else UNKNOWN
    if manifest is None and state == UNPROVED:
        state = UNKNOWN
    facts = (store.name, one.id, state, str(store.tree(one.id)), manifest)
    return ReleaseRow(*facts, begins(past).get(one.id, 0), mark or end)


def judge_releases(manager: Manager, scope: Scope) -> Iterator[Finding]:
    """The findings of `doractl doctor` about what a killed deploy has left."""
    from dora_systemd.adapters.releases.transfer import leftovers

    for path in leftovers(root_of(scope)):
        text = f"{path} is the rest of a deploy -H that was killed"
        yield Finding("releases", State.NOTE, text, "the next one removes it")
    for name in deployed_names(scope):
        try:
            yield from _judge(manager, scope, name)
        except DoraSystemdError as error:  # of one dataflow, which must not hide the others
            yield Finding("releases", State.WARNING, error.message, error.hint)


def _judge(manager: Manager, scope: Scope, name: str) -> Iterator[Finding]:
    store, standing = store_of(scope, name), read_standing(manager, scope, unit_name(name))
    if standing.trial:
        text = f"{name} runs release {standing.trial} on trial, and the next boot does not"
        remedy = f"doractl deploy --name {name}, or doractl rollback {name}"
        yield Finding("releases", State.WARNING, text, remedy)
    for path in () if is_locked(store) else remains(store, standing):
        text = f"{path} is the rest of a deploy that was killed"
        yield Finding("releases", State.NOTE, text, "the next deploy removes it")
    if lost := store.lost_changes():
        text = f"{store.path / HISTORY} has {counted(lost, 'damaged line')}: rollback ignores them"
        remedy = f"check the disk; doractl releases {name} --history lists the others"
        yield Finding("releases", State.WARNING, text, remedy)


def refuse_on_trial(scope: Scope, cell: Cell, verb: str) -> None:
    """Raise DoraSystemdError if a deploy or rollback tries a release of the dataflow now.

    The commit or the way back of that trial would undo half of what `verb` does to the unit.
    """
    options = trial_options(scope, cell.unit)
    if options and is_locked(store_of(scope, cell.name)):
        raise DoraSystemdError(
            f"cannot {verb} {cell.name}: release {release_of(options.dataflow)} is on trial",
            f"wait until that has ended; doractl releases {cell.name} shows it",
        )

"""`doractl forget`: removes one release, or all that is kept of a dataflow."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.adapters.releases.store import Store, locked
from dora_systemd.decisions.logs.journal_events import FORGOTTEN
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import did_you_mean, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import is_directory
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.releases.build import clean
from dora_systemd.verbs.releases.listing import deployed_names, store_of
from dora_systemd.verbs.releases.trial import Standing, note_removal, read_standing

_COMMAND = "doractl forget"


class Kept(NamedTuple):
    """The files that are kept of a dataflow."""

    name: str
    uuid: str  # "" if unknown
    releases: tuple[str, ...]  # their ids

    @property
    def unit(self) -> str:
        return unit_name(self.name)


def find_kept(manager: Manager, scope: Scope, selector: str) -> Kept:
    """Find what is kept of the dataflow that is meant.

    Raises DoraSystemdError: NOT_FOUND; NAME_IN_USE while the dataflow runs or is enabled.
    """
    name = Selector(selector).find_name(manager, scope, deployed_names(scope))
    store, standing = store_of(scope, name), read_standing(manager, scope, unit_name(name))
    _require_unused(standing, name)
    uuid = standing.uuid or _uuid_of(store)
    if not uuid and (ended := Selector(name).ended(scope)):
        uuid = ended.uuid
    return Kept(name, uuid, tuple(one.id for one in store.known()))


def forget(manager: Manager, scope: Scope, kept: Kept) -> None:
    """Remove all releases and the history of a dataflow, and what systemd keeps of its end.

    Raises DoraSystemdError as find_kept(), and if something cannot be removed.
    """
    store = store_of(scope, kept.name)
    if is_directory(store.path):
        with locked(store, make=False):
            standing = read_standing(manager, scope, kept.unit)
            _require_unused(standing, kept.name)
            clean(manager, store, standing)
            store.remove_all()
    with suppress(DoraSystemdError):  # systemd need not know it
        manager.reset_failed(kept.unit)
    note_request(FORGOTTEN, kept.name, kept.uuid, _COMMAND, scope=scope.word)


def remove_releases(
    manager: Manager, scope: Scope, selector: str, releases: tuple[str, ...]
) -> Iterator[tuple[Kept, str]]:
    """Remove releases; yields each with its dataflow.

    Raises DoraSystemdError: NOT_FOUND; NAME_IN_USE for the present one and one on trial. Nothing is
    removed then.
    """
    name = Selector(selector).find_name(manager, scope, deployed_names(scope))
    store = store_of(scope, name)
    if not is_directory(store.path):
        hint = f"doractl deploy --name {name} makes the first one"
        raise DoraSystemdError(f"{name} has no release", hint, ExitCode.NOT_FOUND)
    with locked(store, make=False):
        standing = read_standing(manager, scope, unit_name(name))
        known = tuple(one.id for one in store.known())
        for release in releases:
            _require_removable(store, standing, known, release)
        kept = Kept(name, standing.uuid or _uuid_of(store), known)
        for release in dict.fromkeys(releases):
            store.remove(release)
            note_removal(store, standing, release, _COMMAND)
            yield kept, release


def _require_unused(standing: Standing, name: str) -> None:
    if standing.running or standing.trial:
        message, hint = f"cannot forget {name}: it is running", f"doractl stop {name}"
    elif standing.boot.text is not None or standing.boot.is_wanted:
        reason = "it is enabled" if standing.boot.is_wanted else "its unit file is kept"
        message, hint = f"cannot forget {name}: {reason}", f"doractl disable {name}"
    else:
        return
    raise DoraSystemdError(message, f"{hint}, then repeat this command", ExitCode.NAME_IN_USE)


def _require_removable(
    store: Store, standing: Standing, known: tuple[str, ...], release: str
) -> None:
    if release not in known:
        hint = did_you_mean(release, list(known)) or f"doractl releases {store.name} lists all"
        message = f"{store.name} has no release {quoted(release)}"
        raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND)
    if release in (standing.current, standing.trial):
        message = f"cannot remove release {release} of {store.name}: it is what every start runs"
        if release == standing.trial:
            message = f"cannot remove release {release} of {store.name}: it is on trial"
        hint = f"doractl rollback {store.name}, or deploy another release first"
        raise DoraSystemdError(message, hint, ExitCode.NAME_IN_USE)


def _uuid_of(store: Store) -> str:
    for one in reversed(store.known()):
        with suppress(DoraSystemdError):
            return store.manifest(one.id).uuid
    return ""

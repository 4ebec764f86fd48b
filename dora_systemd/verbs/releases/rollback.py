"""`doractl rollback`: an older release proves itself once more, and takes the place of this one."""

import pwd
from functools import partial

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.adapters.releases.store import Store, locked
from dora_systemd.decisions.logs.journal_events import ROLLED_BACK
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.releases.past import before
from dora_systemd.decisions.releases.progress import checking, waiting
from dora_systemd.decisions.unit.file import runner_of, user_of
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import did_you_mean, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import is_directory
from dora_systemd.values import quoted, shown
from dora_systemd.verbs.facts.locks import IfInhibited, require_uninhibited
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.releases.build import clean
from dora_systemd.verbs.releases.change import Change, change_release, stop_observer
from dora_systemd.verbs.releases.deploy import Deployed
from dora_systemd.verbs.releases.listing import deployed_names, store_of
from dora_systemd.verbs.releases.soak import Gate, Tell
from dora_systemd.verbs.releases.trial import (
    KILLED,
    Standing,
    go_back,
    note_fault,
    read_after_wait,
    read_deployable,
    read_past,
)

_COMMAND = "doractl rollback"


def roll_back(
    manager: Manager,
    scope: Scope,
    selector: str,
    release: str | None,
    soak: int,
    tell: Tell,
    how: IfInhibited = IfInhibited.REFUSE,
    by: str = _COMMAND,
    may_wait: bool = False,
) -> Deployed:
    """Run an older release. release: its id; None for the one before the present one.

    Without one before, ends a trial whose doractl was killed; the id of what runs then is "".
    soak: µs. how: what to do while a lock inhibits it. by: as in note_request(). may_wait: as of
    Gate.

    Raises DoraSystemdError: ROLLED_BACK if that release fails its trial, INHIBITED.
    """
    store = store_of(scope, deployed_name(manager, scope, selector))
    with locked(store, make=False):
        standing = read_deployable(manager, scope, unit_name(store.name))
        clean(manager, store, standing)
        if release is None and standing.trial and not standing.current:
            require_uninhibited(
                scope, standing.running, "rollback", how, lambda text: tell(waiting(text))
            )
            standing = read_after_wait(manager, scope, standing, "rollback")
            return _end_first(manager, store, standing, by, tell)
        chosen = _choose(store, standing, release)
        text = store.unit(chosen)
        options, manifest = runner_of(text, can_start=True), store.manifest(chosen)
        if options is None or options.name != store.name:
            message = f"cannot run release {chosen} of {store.name}: it has no unit file of ours"
            raise bad_input(message, f"doractl releases {store.name} lists the others")
        if chosen != standing.current or not standing.trial:  # a trial has to end in any case
            tell(checking())
            _require_intact(store, manifest)
            _require_user(store, chosen, user_of(text))
        # One that was disabled stays so.
        change = Change(chosen, text, options, soak, False, "rollback", how, by)
        gate = partial(Gate, may_wait=may_wait)
        change_release(manager, scope, store, standing, change, tell, gate)
    facts = (options.uuid, store.name, standing.boot.unit, chosen, standing.current)
    return Deployed(*facts, len(manifest.files), manifest.size, 0)


def deployed_name(manager: Manager, scope: Scope, selector: str) -> str:
    """The name of the dataflow with releases that is meant. Raises DoraSystemdError (NOT_FOUND)."""
    known = deployed_names(scope)
    name = Selector(selector).find_name(manager, scope, known)
    if name not in known:
        hint = f"doractl deploy --name {name} makes the first one"
        raise DoraSystemdError(f"{name} has no release", hint, ExitCode.NOT_FOUND)
    return name


def _require_intact(store: Store, manifest: Manifest) -> None:
    """Refuse a release that is not what has proved itself; a trial may not notice the damage."""
    if damaged := sorted(manifest.files.keys() - store.intact(manifest).keys()):
        more = f" and {len(damaged) - 1} more" if len(damaged) > 1 else ""
        reason = f"{shown(damaged[0])}{more} changed on the disk"
        message = f"cannot run release {manifest.id} of {store.name}: it is damaged: {reason}"
        raise bad_input(message, f"check the disk; doractl releases {store.name} lists the others")


def _require_user(store: Store, release: str, user: str) -> None:
    """Refuse a release whose user is gone: its start would fail after the stop of what runs."""
    try:
        if user:
            pwd.getpwnam(user)
    except KeyError as error:
        message = f"cannot run release {release} of {store.name}: there is no user {shown(user)}"
        raise bad_input(message, "create that user, or deploy again with --uid USER") from error


def _end_first(manager: Manager, store: Store, standing: Standing, by: str, tell: Tell) -> Deployed:
    """End the trial of the first release, and run again what ran before that release."""
    for cell in standing.running:
        note_request("stop-asked", cell.name, cell.uuid, by)
    note_fault(store, standing, standing.trial, Fault(KILLED, is_outside=True), by)
    go_back(manager, standing, standing.was_up, stop_observer(tell))
    uuid = standing.uuid or store.manifest(standing.trial).uuid
    details = {"release": standing.trial, "former": "", "nodes": "", "reason": KILLED}
    note_request(ROLLED_BACK, store.name, uuid, by, **details)
    return Deployed(uuid, store.name, standing.boot.unit, "", standing.trial, 0, 0, 0)


def _choose(store: Store, standing: Standing, release: str | None) -> str:
    if release is None:
        # A trial whose doractl was killed: what is on the disk has proved itself.
        return standing.current if standing.trial else _before(store, standing)
    ids = [one.id for one in store.known()]
    if release not in ids:
        hint = did_you_mean(release, ids) or f"doractl releases {store.name} lists all"
        message = f"{store.name} has no release {quoted(release)}"
        raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND)
    if not is_directory(store.tree(release)):
        message = f"cannot run release {release} of {store.name}: its files are gone"
        raise bad_input(message, f"doractl releases {store.name} lists the others")
    return release


def _before(store: Store, standing: Standing) -> str:
    """Return the release that ran well before the present one; never one rolled back from."""
    past, current = read_past(store, standing.current), standing.current
    if chosen := before(store.known(), current, past):
        return chosen
    hint = f"doractl releases {store.name} lists all; give the id of one to run it in any case"
    message = f"{store.name} has no release before the present one that ran well"
    raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND)

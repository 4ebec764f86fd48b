"""`doractl deploy`: copies a project into a release, and lets it prove itself."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.store import Store, locked, unusable
from dora_systemd.decisions.releases.choice import surplus
from dora_systemd.decisions.releases.entries import Stored, touched
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.releases.progress import checking, waiting
from dora_systemd.decisions.unit.file import persistent_unit, runner_of
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.project import opened_project
from dora_systemd.values import SECOND
from dora_systemd.verbs.inhibit.guard import IfInhibited, require_uninhibited
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.clean import clean
from dora_systemd.verbs.releases.copy import copy_project, newest, repository_owners
from dora_systemd.verbs.releases.files import digests, find_files
from dora_systemd.verbs.releases.listing import store_of
from dora_systemd.verbs.releases.past import read_past
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import (
    Source,
    find_source,
    released,
    require_same,
    source_notes,
)
from dora_systemd.verbs.releases.trial import (
    read_after_wait,
    read_standing,
    require_deployable,
)
from dora_systemd.verbs.start.account import account_of
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.plan import Plan, StartRequest, make_plan
from dora_systemd.verbs.start.unit import plan_properties

_COMMAND = "doractl deploy"
BUILD_TIMEOUT = 30 * 60 * SECOND


@dataclass(frozen=True)
class DeployRequest:
    """A deploy. start: as of `doractl start`; its dataflow may be a directory. soak: µs.

    how: what to do while a lock inhibits it. build_timeout: µs; 0: without a build.
    """

    start: StartRequest
    soak: int
    keep: int
    want_boot: bool
    how: IfInhibited = IfInhibited.REFUSE
    build_timeout: int = BUILD_TIMEOUT


class Deployed(NamedTuple):
    """A release that runs. size: bytes of its files; copied: of those that no other one has."""

    uuid: str
    name: str
    unit: str
    release: str
    former: str
    files: int
    size: int
    copied: int


def compare(
    manager: Manager, scope: Scope, request: StartRequest, want_build: bool = True
) -> tuple[str, dict[str, list[str]]]:
    """What a deploy would change: the present release, and paths, but none that a build makes.

    Raises DoraSystemdError.
    """
    source = find_source(scope, request, want_build)
    last = present(manager, scope, store_of(scope, source.plan.options.name))
    with opened_project(source.root, account_of(source.plan.user)) as project:
        found, _ = find_files(project, source.named, repository_owners(source))
        return last.id if last else "", touched(of_project(last), digests(project, found))


def of_project(release: Manifest | None) -> dict[str, Stored]:
    """The files of a release that its project had, and no build has made."""
    files = release.files if release else {}
    return {path: one for path, one in files.items() if not one.is_built}


def present(manager: Manager, scope: Scope, store: Store) -> Manifest | None:
    """The manifest of the release that every start runs, or of the newest one."""
    current = read_standing(manager, scope, unit_name(store.name)).current
    with suppress(DoraSystemdError):  # it is not readable, or "" is no release
        return store.manifest(current)
    return newest(store)


def deploy(
    manager: Manager,
    scope: Scope,
    request: DeployRequest,
    tell: Tell,
    warn: Callable[[str], None],
    source: Source | None = None,
) -> Deployed:
    """Deploy a project. tell: gets each step; warn: each warning. source: it, if that is known.

    Raises DoraSystemdError: ROLLED_BACK if the release has failed its trial. After any other error
    everything is as before.
    """
    source = source or find_source(scope, request.start, bool(request.build_timeout))
    name = source.plan.options.name
    store, standing = store_of(scope, name), read_standing(manager, scope, unit_name(name))
    require_deployable(manager, scope, standing)
    with locked(store):
        standing = read_standing(manager, scope, standing.boot.unit)  # nobody changes it now
        require_uninhibited(
            scope, standing.running, "deploy", request.how, lambda text: tell(waiting(text))
        )
        standing = read_after_wait(manager, scope, standing, "deploy")
        clean(manager, store, standing)
        copy = copy_project(manager, scope, source, store, standing, request.build_timeout, tell)
        release = copy.manifest.id
        try:
            text = _unit_text(manager, scope, source, store, request, copy.manifest, tell, warn)
            store.write_unit(release, text)
        except BaseException as error:
            store.remove(release)
            if isinstance(error, DoraSystemdError):
                raise _at_source(error, store, release, source) from error
            if isinstance(error, OSError):
                raise unusable(store.path, error) from error
            raise
        options = runner_of(text)
        assert options is not None
        for note in (*copy.notes, *source_notes(source, store.tree(release))):
            warn(note)
        standing = read_standing(manager, scope, standing.boot.unit)  # the copy took its time
        require_deployable(manager, scope, standing)
        how, want_boot = request.how, request.want_boot
        change = Change(release, text, options, request.soak, want_boot, "deploy", how, _COMMAND)
        try:
            change_release(manager, scope, store, standing, change, tell)
        except BaseException as error:
            if getattr(error, "code", None) is not ExitCode.ROLLED_BACK:
                _remove_unused(manager, scope, store, release)
            raise
        finally:
            prune(manager, scope, store, request.keep, release)
    manifest = copy.manifest
    facts = (options.uuid, name, standing.boot.unit, release, standing.current)
    return Deployed(*facts, len(manifest.files), manifest.size, copy.copied)


def prune(manager: Manager, scope: Scope, store: Store, keep: int, latest: str) -> None:
    """Remove the oldest releases beyond `keep`. latest: the one that was tried.

    What cannot be removed now can be after the next deploy.
    """
    with suppress(DoraSystemdError, OSError):
        standing = read_standing(manager, scope, unit_name(store.name))
        used = {latest, standing.trial}
        past = read_past(store, standing.current)
        for release in surplus(store.known(), keep, standing.current, used, past):
            store.remove(release)


def _remove_unused(manager: Manager, scope: Scope, store: Store, release: str) -> None:
    """Remove a release that has never been tried, unless it can still be what runs."""
    with suppress(DoraSystemdError):
        standing = read_standing(manager, scope, unit_name(store.name))
        if release not in (standing.current, standing.trial):
            store.remove(release)


def _unit_text(
    manager: Manager,
    scope: Scope,
    source: Source,
    store: Store,
    request: DeployRequest,
    manifest: Manifest,
    tell: Tell,
    warn: Callable[[str], None],
) -> str:
    """The unit file of the copy, which has been checked as for a start."""
    tell(checking())
    tree = store.tree(manifest.id)
    require_same(source, tree)
    wanted = released(source, request.start, tree, manifest.uuid)
    plan = make_plan(scope, wanted)
    versions = {**manifest.versions, **check_plan(lambda: manager, plan)}
    store.write_manifest(replace(manifest, versions={**versions, "systemd": manager.version()}))
    properties, warnings = plan_properties(plan, manager)
    for warning in warnings:
        warn(warning)
    return _persistent(manager, scope, plan, format_unit(properties))


def _at_source(
    error: DoraSystemdError, store: Store, release: str, source: Source
) -> DoraSystemdError:
    """The error with the paths of the project: those of the copy are gone."""
    tree = str(store.tree(release))
    message, hint = (text.replace(tree, source.root) for text in (error.message, error.hint))
    if source.dora and "dora build" in hint:
        hint = "the build has to make it there"
    return DoraSystemdError(message, hint, error.code)


def _persistent(manager: Manager, scope: Scope, plan: Plan, text: str) -> str:
    target = boot_target(manager, scope)
    return persistent_unit([text], plan.options, scope.is_user, target)

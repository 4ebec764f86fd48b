"""`doractl deploy`: copies a project into a release, and lets it prove itself."""

import os
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from dora_systemd import __version__
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store, locked, unusable
from dora_systemd.decisions.releases.choice import surplus
from dora_systemd.decisions.releases.entries import Found, touched
from dora_systemd.decisions.releases.ids import new_id
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.unit.file import persistent_unit, runner_of
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.values import format_rounded_size
from dora_systemd.verbs.inhibit.guard import IfInhibited, require_uninhibited
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.files import copy_files, digests, find_files
from dora_systemd.verbs.releases.listing import store_of
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import (
    Source,
    find_source,
    released,
    require_same,
    source_notes,
)
from dora_systemd.verbs.releases.trial import Standing, read_standing, require_deployable
from dora_systemd.verbs.start.account import account_of
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.plan import Plan, StartRequest, make_plan
from dora_systemd.verbs.start.unit import plan_properties

_COMMAND = "doractl deploy"
_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class DeployRequest:
    """A deploy. start: as of `doractl start`; its dataflow may be a directory. soak: µs.

    how: what to do while a lock inhibits it.
    """

    start: StartRequest
    soak: int
    keep: int
    want_boot: bool
    how: IfInhibited = IfInhibited.REFUSE


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


class _Copy(NamedTuple):
    """A copied project."""

    manifest: Manifest
    copied: int


def compare(scope: Scope, request: StartRequest) -> tuple[str, dict[str, list[str]]]:
    """What a deploy would change: the newest release, and paths. Raises DoraSystemdError."""
    source = find_source(scope, request)
    store = store_of(scope, source.plan.options.name)
    last = newest(store)
    with opened_project(source.root, account_of(source.plan.user)) as project:
        found, _ = find_files(project, source.named, _owners(source))
        return last.id if last else "", touched(last.files if last else {}, digests(project, found))


def deploy(
    manager: Manager,
    scope: Scope,
    request: DeployRequest,
    tell: Tell,
    warn: Callable[[str], None],
    source: Source | None = None,
) -> Deployed:
    """Deploy a project. tell: gets each stage; warn: each warning. source: it, if that is known.

    Raises DoraSystemdError: ROLLED_BACK if the release has failed its trial. After any other error
    everything is as before.
    """
    source = source or find_source(scope, request.start)
    name = source.plan.options.name
    store, standing = store_of(scope, name), read_standing(manager, scope, unit_name(name))
    require_deployable(manager, scope, standing)
    with locked(store):
        standing = read_standing(manager, scope, standing.boot.unit)  # nobody changes it now
        require_uninhibited(scope, standing.running, "deploy", request.how, tell)
        store.clean()
        copy = _copy_project(source, store, standing, tell)
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
        for note in source_notes(source):
            warn(note)
        standing = read_standing(manager, scope, standing.boot.unit)  # the copy took its time
        require_deployable(manager, scope, standing)
        how, want_boot = request.how, request.want_boot
        change = Change(release, text, options, request.soak, want_boot, _COMMAND, how)
        try:
            change_release(manager, scope, store, standing, change, tell)
        finally:
            prune(manager, scope, store, request.keep, release)
    manifest = copy.manifest
    facts = (options.uuid, name, standing.boot.unit, release, standing.current)
    return Deployed(*facts, len(manifest.files), manifest.size, copy.copied)


def newest(store: Store) -> Manifest | None:
    """The manifest of the newest release that has one."""
    for one in reversed(store.known()):
        try:
            return store.manifest(one.id)
        except DoraSystemdError:
            continue
    return None


def prune(manager: Manager, scope: Scope, store: Store, keep: int, latest: str) -> None:
    """Remove the oldest releases beyond `keep`. latest: the one that was tried.

    What cannot be removed now can be after the next deploy.
    """
    with suppress(DoraSystemdError, OSError):
        standing = read_standing(manager, scope, unit_name(store.name))
        used = {latest, standing.trial}
        for release in surplus(store.known(), keep, standing.current, used):
            store.remove(release)


def _owners(source: Source) -> list[int]:
    """Whose repositories git may read: root's, and those of the user that reads."""
    user = source.plan.user
    return [0, os.geteuid() if user is None else user.pw_uid]


def _copy_project(source: Source, store: Store, standing: Standing, tell: Tell) -> _Copy:
    user = source.plan.user
    last = newest(store)
    draft = None
    try:
        with opened_project(source.root, account_of(user)) as project:
            found, revision = find_files(project, source.named, _owners(source))
            revision = source.revision if source.sent else revision
            draft = Draft(store)
            manifest = _fill(project, found, draft, last, source, revision, tell)
            shared = last.files if last else {}
            copied = sum(
                one.size for path, one in manifest.files.items() if shared.get(path) != one
            )
            uuid_ = standing.uuid or (last.uuid if last else "") or str(uuid.uuid4())
            known = frozenset(one.id for one in store.known())
            release = new_id(manifest.created_us, revision, known)
            manifest = Manifest(**{**vars(manifest), "id": release, "uuid": uuid_})
            draft.publish(manifest, None if user is None else user.pw_gid)
            return _Copy(manifest, copied)
    except OSError as error:
        raise unusable(store.path, error) from error
    finally:
        if draft is not None:
            draft.discard()


def _fill(
    project: Project,
    found: dict[str, Found],
    draft: Draft,
    last: Manifest | None,
    source: Source,
    revision: str,
    tell: Tell,
) -> Manifest:
    def progress(done: int, total: int) -> None:
        tell(f"copying: {format_rounded_size(done)} of {format_rounded_size(total)}")

    files = copy_files(project, found, draft, last, progress)
    user = source.plan.user
    return Manifest(
        id="",
        name=source.plan.options.name,
        uuid="",
        dataflow=source.dataflow,
        source=source.sent or source.root,
        user="" if user is None else user.pw_name,
        revision=revision,
        created_us=time.time_ns() // _MICROSECOND_NS,
        versions={"dora-systemd": __version__},
        files=files,
    )


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
    tell("checking")
    tree = store.tree(manifest.id)
    require_same(source, tree)
    wanted = released(source, request.start, tree, manifest.uuid)
    plan = make_plan(scope, wanted)
    check_plan(lambda: manager, plan)
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
    return DoraSystemdError(message, hint, error.code)


def _persistent(manager: Manager, scope: Scope, plan: Plan, text: str) -> str:
    target = boot_target(manager, scope)
    return persistent_unit([text], plan.options, scope.is_user, target)

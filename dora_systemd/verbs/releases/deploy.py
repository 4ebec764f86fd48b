"""`doractl deploy`: copies a project into a release, and lets it prove itself."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.store import Store, locked, unusable
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.releases.manifest import (
    FILE,
    LINK,
    Found,
    Manifest,
    Stored,
    of_project,
    touched,
)
from dora_systemd.decisions.releases.past import surplus
from dora_systemd.decisions.releases.progress import checking, waiting
from dora_systemd.decisions.settings.differences import lost_options
from dora_systemd.decisions.settings.resolve import given_texts
from dora_systemd.decisions.unit.file import persistent_unit, runner_of, user_of, with_boot_check
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import settings_path, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.project import opened_project
from dora_systemd.values import SECOND, shown
from dora_systemd.verbs.facts.locks import IfInhibited, require_uninhibited
from dora_systemd.verbs.releases.build import clean
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.copy import copy_project, newest, repository_owners
from dora_systemd.verbs.releases.files import digests, find_files
from dora_systemd.verbs.releases.listing import store_of
from dora_systemd.verbs.releases.soak import Gate, Tell
from dora_systemd.verbs.releases.source import (
    Source,
    find_source,
    released,
    require_same,
    source_notes,
)
from dora_systemd.verbs.releases.trial import (
    Standing,
    read_after_wait,
    read_deployable,
    read_past,
    read_standing,
)
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.request import StartRequest, current_directory
from dora_systemd.verbs.start.start import require_same_user
from dora_systemd.verbs.start.unit import plan_properties
from dora_systemd.verbs.start.where import account_of

_COMMAND = "doractl deploy"
BUILD_TIMEOUT = 30 * 60 * SECOND


@dataclass(frozen=True)
class DeployRequest:
    """A request to deploy a project."""

    start: StartRequest  # as of `doractl start`; its dataflow may be a directory
    soak: int  # µs
    keep: int  # releases
    want_boot: bool
    # what to do while a lock inhibits the deploy; FORCE also deploys what has not changed
    how: IfInhibited = IfInhibited.REFUSE
    build_timeout: int = BUILD_TIMEOUT  # µs; 0: without a build
    may_wait: bool = False  # as of Gate


class Deployed(NamedTuple):
    """A release that runs."""

    uuid: str
    name: str
    unit: str
    release: str
    former: str
    files: int
    size: int  # bytes of its files
    copied: int  # bytes of its files that no other release has
    # whether it ran before, and the project and the settings have not changed since
    is_unchanged: bool = False


def compare(
    manager: Manager, scope: Scope, request: StartRequest, want_build: bool = True
) -> tuple[str, dict[str, list[str]]]:
    """Find what a deploy would change: the present release, and paths, but none that a build makes.

    Raises DoraSystemdError.
    """
    source = find_source(scope, request, want_build)
    last = present(manager, scope, store_of(scope, source.plan.options.name))
    with opened_project(source.root, account_of(source.plan.user)) as project:
        found, _ = find_files(project, source.named, repository_owners(source))
        known = of_project(last.files) if last else {}
        return last.id if last else "", touched(known, dict(digests(project, found, known)))


def present(manager: Manager, scope: Scope, store: Store) -> Manifest | None:
    """The manifest of the release that every start runs, or of the newest one."""
    return _manifest_of(store, read_standing(manager, scope, unit_name(store.name)))


def _manifest_of(store: Store, standing: Standing) -> Manifest | None:
    with suppress(DoraSystemdError):  # it is not readable, or "" is no release
        return store.manifest(standing.current)
    return newest(store)


@dataclass(frozen=True)
class _Deploy:
    """A deploy under way. The fields are the arguments of deploy()."""

    manager: Manager
    scope: Scope
    request: DeployRequest
    tell: Tell
    warn: Callable[[str], None]
    source: Source
    store: Store


def deploy(
    manager: Manager,
    scope: Scope,
    request: DeployRequest,
    tell: Tell,
    warn: Callable[[str], None],
    source: Source | None = None,
) -> Deployed:
    """Deploy a project. `tell`: gets each step; warn: each warning. source: the project, if known.

    Raises DoraSystemdError: ROLLED_BACK if the release has failed its trial. After any other error
    everything is as before.
    """
    source = source or find_source(scope, request.start, bool(request.build_timeout))
    store = store_of(scope, source.plan.options.name)
    work, unit = _Deploy(manager, scope, request, tell, warn, source, store), unit_name(store.name)
    read_deployable(manager, scope, unit)  # refused before there is a directory for its releases
    with locked(store):
        standing = read_deployable(manager, scope, unit)  # from here on no other deploy changes it
        require_same_user("deploy", source.plan, _user_of(manager, standing, newest(store)))
        if same := _find_same(work, standing):
            prune(manager, scope, store, request.keep, same.id)
            return _deployed(standing, same, 0, is_unchanged=True)
        require_uninhibited(
            scope, standing.running, "deploy", request.how, lambda text: tell(waiting(text))
        )
        standing = read_after_wait(manager, scope, standing, "deploy")
        clean(manager, store, standing)
        former = _manifest_of(store, standing)
        copy = copy_project(manager, scope, source, store, standing, request.build_timeout, tell)
        release = copy.manifest.id
        text, options = _checked(work, copy.manifest)
        lost = _lost_note(former, request.start, source)
        for note in (*copy.notes, *source_notes(source, store.tree(release)), *lost):
            warn(note)
        standing = read_deployable(manager, scope, unit)  # the copy took its time
        how, want_boot = request.how, request.want_boot
        change = Change(release, text, options, request.soak, want_boot, "deploy", how, _COMMAND)
        try:
            gate = partial(Gate, may_wait=request.may_wait)
            change_release(manager, scope, store, standing, change, tell, gate)
        except BaseException as error:
            if getattr(error, "code", None) is not ExitCode.ROLLED_BACK:
                _remove_unused(work, release)
            raise
        finally:
            prune(manager, scope, store, request.keep, release)
    return _deployed(standing, copy.manifest, copy.copied)


def _user_of(manager: Manager, standing: Standing, last: Manifest | None) -> str:
    """Find as whom the dataflow of that name runs: by its unit file, its unit or a release."""
    if standing.boot.text is not None:
        return user_of(standing.boot.text)
    if standing.running:
        return str(manager.read(standing.boot.unit, ["User"])["User"])
    return last.user if last else ""


def _deployed(
    standing: Standing, manifest: Manifest, copied: int, is_unchanged: bool = False
) -> Deployed:
    """Describe the release that runs. standing: of before."""
    former = "" if is_unchanged else standing.current
    facts = (manifest.uuid, manifest.name, standing.boot.unit, manifest.id, former)
    return Deployed(*facts, len(manifest.files), manifest.size, copied, is_unchanged)


def prune(manager: Manager, scope: Scope, store: Store, keep: int, latest: str) -> None:
    """Remove the oldest releases beyond `keep`. latest: the one that was tried.

    What cannot be removed now can be after the next deploy.
    """
    with suppress(DoraSystemdError, OSError):
        standing = read_standing(manager, scope, unit_name(store.name))  # after the trial
        used = {latest, standing.trial}
        past = read_past(store, standing.current)
        for release in surplus(store.known(), keep, standing.current, used, past):
            store.remove(release)


def _remove_unused(work: _Deploy, release: str) -> None:
    """Remove a release that has never been tried, unless it can still be what runs."""
    with suppress(DoraSystemdError):
        standing = read_standing(work.manager, work.scope, unit_name(work.store.name))
        if release not in (standing.current, standing.trial):
            work.store.remove(release)


def _checked(work: _Deploy, manifest: Manifest) -> tuple[str, RunnerOptions]:
    """The unit file of the copy, checked as for a start; the copy is removed if that fails."""
    store, release = work.store, manifest.id
    try:
        text = _unit_text(work, manifest)
        store.write_unit(release, text)
    except BaseException as error:
        store.remove(release)
        if isinstance(error, DoraSystemdError):
            raise _at_source(error, store, release, work.source) from error
        if isinstance(error, OSError):
            raise unusable(store.path, error) from error
        raise
    options = runner_of(text)
    assert options is not None
    return text, options


def _unit_text(work: _Deploy, manifest: Manifest) -> str:
    manager, store, start = work.manager, work.store, work.request.start
    work.tell(checking())
    tree = store.tree(manifest.id)
    require_same(work.source, tree)
    plan = make_plan(work.scope, released(work.source, start, tree, manifest.uuid))
    versions = {**manifest.versions, **check_plan(lambda: manager, plan)}
    versions |= {"systemd": manager.version()}
    store.write_manifest(replace(manifest, versions=versions, given=_given(start)))
    properties, warnings = plan_properties(plan, manager)
    for warning in warnings:
        work.warn(warning)
    return unit_text(manager, work.scope, plan, format_unit(properties))


def _given(request: StartRequest) -> dict[str, str | list[str]]:
    return given_texts(request.flags, request.environment, current_directory())


def _lost_note(former: Manifest | None, request: StartRequest, source: Source) -> Iterator[str]:
    """Warn of options of the last deploy that have no effect any more."""
    settings = source.plan.settings
    if former and (lost := lost_options(former.given, _given(request), settings)):
        file = shown(Path(settings_path(source.dataflow)).name)
        hint = f"give them again, or write them to {file}, to keep them"
        yield f"options of release {former.id} are not given any more: {', '.join(lost)}; {hint}"


def _at_source(
    error: DoraSystemdError, store: Store, release: str, source: Source
) -> DoraSystemdError:
    """Return the error with paths of the project instead of those of the removed copy."""
    tree = str(store.tree(release))
    message, hint = (text.replace(tree, source.root) for text in (error.message, error.hint))
    if source.dora and "doractl build" in hint:
        hint = "the build has to make it there"
    return DoraSystemdError(message, hint, error.code)


def _find_same(work: _Deploy, standing: Standing) -> Manifest | None:
    """Find the release that runs, if it has the files and the settings of the project.

    None also if the deploy is to enable it or is forced, and if the deploy reports what prevents
    an answer.
    """
    release, store, source = standing.current, work.store, work.source
    is_to_enable = work.request.want_boot and not standing.boot.is_enabled
    if is_to_enable or work.request.how is IfInhibited.FORCE:
        return None
    if source.is_moving or not _runs(standing, release) or not store.is_proved(release):
        return None
    try:
        manifest, tree = store.manifest(release), store.tree(release)
        if not _has_files_of(source, manifest):
            return None
        require_same(source, tree)
        plan = make_plan(work.scope, released(source, work.request.start, tree, manifest.uuid))
        unit = format_unit(plan_properties(plan, work.manager)[0])
        text = unit_text(work.manager, work.scope, plan, unit)
        has_unit = standing.boot.text in (text, with_boot_check(text))
        return manifest if has_unit and store.intact(manifest) == manifest.files else None
    except (DoraSystemdError, OSError):
        return None


def unit_text(manager: Manager, scope: Scope, plan: Plan, text: str) -> str:
    """Make the unit file of a plan from the text of its transient unit."""
    target = boot_target(manager, scope)
    return persistent_unit([text], plan.options, scope.is_user, target)


def _runs(standing: Standing, release: str) -> bool:
    """Whether every start runs that release, and it runs now."""
    cell = standing.cell
    is_up = cell is not None and cell.state.active == "active" and cell.release == release
    return bool(release and not standing.trial and is_up)


def _has_files_of(source: Source, manifest: Manifest) -> bool:
    """Whether the release has been made from the files that the project has now."""
    known = of_project(manifest.files)
    with opened_project(source.root, account_of(source.plan.user)) as project:
        found, _ = find_files(project, source.named, repository_owners(source))
        # The content is compared last, and only if everything else is equal.
        is_alike = found.keys() == known.keys() and all(
            _is_alike(one, known[path]) for path, one in found.items()
        )
        return is_alike and all(known[path] == one for path, one in digests(project, found, known))


def _is_alike(one: Found, known: Stored) -> bool:
    if one.kind == LINK or known.target:
        return one.target == known.target
    return (one.kind, one.size, one.is_executable) == (FILE, known.size, known.is_executable)

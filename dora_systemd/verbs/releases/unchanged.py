"""Finds whether a deploy would make again what runs, which then is left alone."""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.entries import FILE, LINK, Found, Stored, of_project
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.unit.file import persistent_unit, with_boot_check
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.project import opened_project
from dora_systemd.verbs.releases.copy import repository_owners
from dora_systemd.verbs.releases.files import digests, find_files
from dora_systemd.verbs.releases.source import Source, released, require_same
from dora_systemd.verbs.releases.trial import Standing
from dora_systemd.verbs.start.account import account_of
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.plan import Plan, StartRequest, make_plan
from dora_systemd.verbs.start.unit import plan_properties


def find_unchanged(
    manager: Manager,
    scope: Scope,
    source: Source,
    store: Store,
    standing: Standing,
    request: StartRequest,
) -> Manifest | None:
    """Find the release that runs, if it has the files and the settings of `source`.

    request: of the deploy. None also if that cannot be told: then the deploy reports why.
    """
    release = standing.current
    if source.is_moving or not _runs(standing, release) or not store.is_proved(release):
        return None
    try:
        manifest, tree = store.manifest(release), store.tree(release)
        if not _has_files_of(source, manifest):
            return None
        require_same(source, tree)
        plan = make_plan(scope, released(source, request, tree, manifest.uuid))
        text = unit_text(manager, scope, plan, format_unit(plan_properties(plan, manager)[0]))
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
        # The content is read last, and only if all else is the same.
        is_alike = found.keys() == known.keys() and all(
            _is_alike(one, known[path]) for path, one in found.items()
        )
        return is_alike and digests(project, found) == known


def _is_alike(one: Found, known: Stored) -> bool:
    if one.kind == LINK or known.target:
        return one.target == known.target
    return (one.kind, one.size, one.is_executable) == (FILE, known.size, known.is_executable)

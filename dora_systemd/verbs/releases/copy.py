"""Copies a project into a release, built if it has to be, that has its name then."""

import os
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple

from dora_systemd import __version__
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store, unusable
from dora_systemd.decisions.releases.build import build_commands
from dora_systemd.decisions.releases.manifest import Found, Manifest, Stored, new_id
from dora_systemd.decisions.releases.progress import building, copied, copying
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.project import Project, opened_project
from dora_systemd.verbs.releases.build import Build, built_project
from dora_systemd.verbs.releases.files import copy_files, find_files, seen_before
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import Source
from dora_systemd.verbs.releases.trial import Standing
from dora_systemd.verbs.start.where import account_of

_MICROSECOND_NS = 1000


class Copied(NamedTuple):
    """A copied project."""

    manifest: Manifest
    copied: int  # bytes of its files that the last release does not have
    notes: tuple[str, ...] = ()  # warnings about the last release (human-readable)


def newest(store: Store) -> Manifest | None:
    """The manifest of the newest release that has one."""
    for one in reversed(store.known()):
        try:
            return store.manifest(one.id)
        except DoraSystemdError:
            continue
    return None


def repository_owners(source: Source) -> list[int]:
    """Return the users whose repositories git may read: root, and the user that reads."""
    user = source.plan.user
    return [0, os.geteuid() if user is None else user.pw_uid]


def copy_project(
    manager: Manager,
    scope: Scope,
    source: Source,
    store: Store,
    standing: Standing,
    build_timeout: int,
    tell: Tell,
) -> Copied:
    """Copy the project of `source`. build_timeout: µs.

    Raises DoraSystemdError (BAD_INPUT) for a file that no release can have, and for a failed build;
    then no part of the copy stays.
    """
    user = source.plan.user
    last = newest(store)
    draft = None
    try:
        with ExitStack() as held:
            project = held.enter_context(opened_project(source.root, account_of(user)))
            found, revision = find_files(project, source.named, repository_owners(source))
            revision = source.revision if source.sent else revision
            manifest = _manifest(source, store, standing, last, revision)
            originals = found.keys()
            if commands := _commands(source, store, manifest, found):
                build = Build(
                    *(scope, source, store, manifest.id, manifest.uuid, commands),
                    build_timeout,
                    on_line=lambda line: tell(building(line)),
                )
                at_work = built_project(manager, build, project, found, tell)
                project, found = held.enter_context(at_work)
            draft = Draft(store)
            draft.require_space(_lacking(found, last))
            files = _fill(project, found, draft, last, tell)
            files = {p: replace(one, is_built=p not in originals) for p, one in files.items()}
            manifest = replace(manifest, files=files)
            shared = last.files if last else {}
            new = sum(one.size for path, one in files.items() if shared.get(path) != one)
            draft.publish(manifest, None if user is None else user.pw_gid)
            tell(copied(len(files), manifest.size, new))
            return Copied(manifest, new, tuple(_damage(last, draft.damaged)))
    except OSError as error:
        raise unusable(store.path, error) from error
    finally:
        if draft is not None:
            draft.discard()


def _damage(last: Manifest | None, paths: Sequence[str]) -> Iterator[str]:
    """The warning about files of the last release that are not what was copied then."""
    if last and paths:
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        now = "the new release has its own copy; check the disk"
        yield f"release {last.id} is damaged: {paths[0]}{more} changed on the disk; {now}"


def _lacking(found: dict[str, Found], last: Manifest | None) -> int:
    """Estimate the bytes that the last release lacks, by sizes; some files may be sparse."""
    old = last.files if last else {}
    sizes = (
        one.size for path, one in found.items() if path not in old or old[path].size != one.size
    )
    return sum(sizes)


def _manifest(
    source: Source, store: Store, standing: Standing, last: Manifest | None, revision: str
) -> Manifest:
    """The manifest of a new release, without its files."""
    user = source.plan.user
    created_us = time.time_ns() // _MICROSECOND_NS
    return Manifest(
        id=new_id(created_us, revision, frozenset(one.id for one in store.known())),
        name=source.plan.options.name,
        uuid=standing.uuid or (last.uuid if last else "") or str(uuid.uuid4()),
        dataflow=source.dataflow,
        source=source.sent or source.root,
        user="" if user is None else user.pw_name,
        revision=revision,
        created_us=created_us,
        versions={"doractl": __version__},
    )


def _commands(
    source: Source, store: Store, manifest: Manifest, found: dict[str, Found]
) -> tuple[tuple[str, ...], ...]:
    if not (source.dora or source.uv):
        return ()
    place = str(store.tree(manifest.id))
    uv, dora, venv = source.uv, source.dora, source.own_venv
    return build_commands(found, place, source.dataflow, uv, dora, venv)


def _fill(
    project: Project, found: dict[str, Found], draft: Draft, last: Manifest | None, tell: Tell
) -> dict[str, Stored]:
    same = seen_before(found, last.files if last else {})
    with draft.reading_ahead(last.id if last else "", same):
        return copy_files(project, found, draft, last, lambda *amount: tell(copying(*amount)))

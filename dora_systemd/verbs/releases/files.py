"""Finds the files of a project that belong to a release, and copies them.

A release has the files that git would track; without git, all but those that .gitignore and the
first rules of hot reload leave out. A release has in any case the files that the dataflow names.
"""

import errno
import hashlib
import posixpath
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from dora_systemd.decisions.releases.manifest import (
    DIRECTORY,
    LINK,
    MOST_FILES,
    Found,
    Manifest,
    Stored,
    check_amount,
    check_found,
    is_revision,
    refusal,
    settled,
    too_many,
)
from dora_systemd.decisions.reload.watch_rules import NOT_OF_PROJECT
from dora_systemd.trust.project import Project

Progress = Callable[[int, int], None]
"""Called with the bytes that are copied, and those of all files."""
Count = Callable[[int], None]
"""Called with the bytes of one file that are read."""


class Target(Protocol):
    """The destination of copied files. All methods raise OSError."""

    def write(self, path: str, chunks: Iterable[bytes], is_executable: bool) -> Stored:
        """Write a file."""

    def share(self, path: str, release_id: str, stored: Stored) -> bool:
        """Share the file with the same path in another release, if it is unchanged."""

    def link(self, path: str, target: str) -> Stored:
        """Create a symbolic link."""


_MOST_LINKS = 40
"""Maximum links in a path, as in Linux, see path_resolution(7)."""
_POINTER, _MOST_POINTER = b"version https://git-lfs.github.com/spec/", 1024
"""How a pointer of Git LFS begins, and the maximum bytes of one."""
_AGAIN = "wait until nothing writes to the project, then deploy again"


def find_files(
    project: Project, named: Sequence[str], owners: Sequence[int]
) -> tuple[dict[str, Found], str]:
    """The files of a release by path, and the revision of git, or "".

    named: paths that belong to it in any case, as far as they exist. owners: of a repository that
    git may read. Raises DoraSystemdError (BAD_INPUT) for what a release cannot have.
    """
    names, revision = project.tracked(owners, MOST_FILES + 1)
    found: dict[str, Found] = {}
    if names is not None and len(names) > MOST_FILES:  # the rest of them is not known
        raise too_many("")
    if names is None:
        found = _walk(project, "")
    found |= _of_git(project, [name.rstrip("/") for name in names or ()])
    found |= _below(project, [path for path in (_real(one, found) for one in named) if path])
    if len(found) > MOST_FILES:
        raise too_many("")
    for one in found.values():
        check_found(one)
    check_amount(found.values())
    return dict(sorted(found.items())), revision if is_revision(revision) else ""


def _of_git(project: Project, names: Sequence[str]) -> dict[str, Found]:
    """The files that git names. Raises DoraSystemdError for a submodule that is not there."""
    found: dict[str, Found] = {}
    for one in _existing(project, names):
        # git names the directory of a repository in the repository, and nothing in it.
        inner = _walk(project, one.path) if one.kind == DIRECTORY else {one.path: one}
        if not inner:
            reason = "it is a repository of git without files, as a submodule that is not there"
            hint = "git submodule update --init, then deploy again; or name it in .gitignore"
            raise refusal(one.path, reason, hint)
        found |= inner
    return found


def _below(project: Project, paths: Sequence[str]) -> dict[str, Found]:
    """Find the existing files with these paths, and all files below directories among them."""
    found: dict[str, Found] = {}
    for one in _existing(project, list(dict.fromkeys(paths))):
        found |= _walk(project, one.path) if one.kind == DIRECTORY else {one.path: one}
    return found


def _real(path: str, found: Mapping[str, Found]) -> str:
    """Resolve links of the release in a path; "" if the result is not in the project.

    A release cannot have a link and, with the same name, a directory.
    """
    for _ in range(_MOST_LINKS):
        parts = path.split("/")
        heads = ("/".join(parts[:count]) for count in range(1, len(parts)))
        link = next((found[head] for head in heads if head in found), None)
        if link is None:
            return path
        rest = path.removeprefix(f"{link.path}/")
        path = posixpath.normpath(posixpath.join(posixpath.dirname(link.path), link.target, rest))
        if path.startswith(("/", "../")):
            break
    return ""


def _existing(project: Project, paths: Sequence[str]) -> Iterator[Found]:
    for row in project.facts(paths) if paths else ():
        if row is not None:
            yield Found(*row)


def _walk(project: Project, top: str) -> dict[str, Found]:
    """Find all files below a directory that no rule leaves out."""
    found: dict[str, Found] = {}
    queue = [top]
    for directory in queue:
        rows = project.walked(directory, MOST_FILES + 1, NOT_OF_PROJECT)
        if len(rows) > MOST_FILES:  # the rest of them is not known
            raise too_many(directory)
        for one in (Found(*row) for row in rows):
            if one.kind == DIRECTORY:
                queue.append(one.path)
            else:
                found[one.path] = one
        if len(found) + len(queue) > MOST_FILES:
            raise too_many(directory)
    return found


def digests(
    project: Project, found: Mapping[str, Found], known: Mapping[str, Stored]
) -> Iterator[tuple[str, Stored]]:
    """Yield what a release of these files would contain, by path, without copying them.

    known: of a release; what has not changed since is not read.
    """
    same = _unchanged(project, found, known)
    for path, one in found.items():
        if one.kind == LINK:
            yield path, Stored(target=one.target)
        else:
            digest = same.get(path) or _digest(project, one)
            yield path, Stored(one.size, one.is_executable, digest)


def seen_before(found: Mapping[str, Found], known: Mapping[str, Stored]) -> list[str]:
    """The paths of files that look as they did when a release recorded them."""
    return [path for path, one in found.items() if path in known and known[path].seen == one.seen]


def _unchanged(
    project: Project, found: Mapping[str, Found], known: Mapping[str, Stored]
) -> dict[str, str]:
    """The digests of the files that have not changed since a release, which knows them.

    The owner of a project who lies about a change gets the former content.
    """
    same = seen_before(found, known)
    now = project.facts(same, opens=True) if same else []
    rows = ((known[path], row) for path, row in zip(same, now, strict=True) if row)
    return {row[0]: one.digest for one, row in rows if Found(*row).seen == one.seen}


def copy_files(
    project: Project,
    found: Mapping[str, Found],
    draft: Target,
    last: Manifest | None,
    progress: Progress,
) -> dict[str, Stored]:
    """Copy the files; those that are as in the release `last` are shared with it.

    Raises OSError, and DoraSystemdError (BAD_INPUT) for a file that changes meanwhile.
    """
    stored: dict[str, Stored] = {}
    begun_ns = time.time_ns()
    total, done = sum(one.size for one in found.values()), 0
    same = _unchanged(project, found, last.files if last else {})
    for path, one in found.items():

        def count(size: int, before: int = done) -> None:
            progress(before + size, total)

        count(0)
        made = _copy(project, one, draft, last, same, count)
        seen = "" if made.target else settled(one, begun_ns)
        stored[path] = replace(made, seen=seen)
        done += one.size
    now = project.facts(list(found)) if found else []
    for one, row in zip(found.values(), now, strict=True):
        if row is None or Found(*row) != one:
            raise _changed(one.path)
    return stored


def _copy(
    project: Project,
    one: Found,
    draft: Target,
    last: Manifest | None,
    same: Mapping[str, str],
    count: Count,
) -> Stored:
    if one.kind == LINK:
        return draft.link(one.path, one.target)
    old = last.files.get(one.path) if last else None
    if last and old and not old.target and _is_same(project, one, old, same, count):
        try:
            if draft.share(one.path, last.id, old):
                return old
        except OSError as error:
            if error.errno not in (errno.EMLINK, errno.EPERM, errno.ENOENT):
                raise
    chunks = _bounded(project.read(one.path), one.path, one.size, count)
    if one.size <= _MOST_POINTER:
        chunks = _no_pointer([*chunks], one.path)
    stored = draft.write(one.path, chunks, one.is_executable)
    if stored.size != one.size:
        raise _changed(one.path)
    return stored


def _no_pointer(chunks: list[bytes], path: str) -> Iterator[bytes]:
    """The chunks of a file. Raises DoraSystemdError for what Git LFS has put in its place."""
    if b"".join(chunks).startswith(_POINTER):
        reason = "it is a pointer of Git LFS, and not the file itself"
        raise refusal(path, reason, "git lfs pull, then deploy again")
    yield from chunks


def _is_same(
    project: Project, one: Found, old: Stored, same: Mapping[str, str], count: Count
) -> bool:
    is_alike = (one.size, one.is_executable) == (old.size, old.is_executable)
    return is_alike and (same.get(one.path) or _digest(project, one, count)) == old.digest


def _digest(project: Project, one: Found, count: Count | None = None) -> str:
    found = hashlib.sha256()
    for chunk in _bounded(project.read(one.path), one.path, one.size, count):
        found.update(chunk)
    return found.hexdigest()


def _bounded(
    chunks: Iterable[bytes], path: str, most: int, count: Count | None = None
) -> Iterator[bytes]:
    size = 0
    for chunk in chunks:
        size += len(chunk)
        if size > most:
            raise _changed(path)
        if count is not None:
            count(size)
        yield chunk


def _changed(path: str) -> Exception:
    return refusal(path, "it changed while it was copied", _AGAIN)

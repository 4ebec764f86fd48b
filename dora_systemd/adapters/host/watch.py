"""Watches the files below a directory, by inotify(7). Only this module imports watchfiles."""

import asyncio
import contextlib
import errno
import os
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.reload.watch_rules import DEFAULT_WATCH, WatchRules
from dora_systemd.errors import DoraSystemdError, words_of
from dora_systemd.names import settings_path
from dora_systemd.trust.files import read_file

DEBOUNCE_MS = 400
"""Maximum time to collect changes that follow each other quickly."""
_STEP_MS = 100
IDLE_MS = 5000
"""Time after which watchfiles reports that nothing has changed. Its watches exist by then."""
_NEW_SECONDS = 0.25
"""Time after which new watches usually exist."""
_GONE_SECONDS = 0.25


def require_watcher(find: Callable[[str], object] = find_spec) -> None:
    """Raise DoraSystemdError if no file can be watched: Debian 12 has no package of watchfiles."""
    if find("watchfiles") is None:
        message = "cannot use hot reload: this system has no Python package watchfiles"
        raise DoraSystemdError(message, "doractl reload NAME takes up changes without it")


class Identity(NamedTuple):
    """The values that distinguish one version of a file from another.

    Times alone do not: the clock may be set back, a file server has its own clock, and a file that
    was moved to the path may be older than the file before.
    """

    path: str  # without links
    device: int
    inode: int
    size: int
    written_ns: int
    changed_ns: int


def identity(path: str) -> Identity | None:
    """Return the identity of the file that `path` leads to, or None if there is none."""
    try:
        found = Path(path).stat()
        times = found.st_mtime_ns, found.st_ctime_ns
        return Identity(os.path.realpath(path), found.st_dev, found.st_ino, found.st_size, *times)
    except (OSError, ValueError):
        return None


class Since(NamedTuple):
    """The start of a run of the dataflow, with which the first check of the files compares."""

    at_ns: int  # CLOCK_MONOTONIC, before the run reads any file
    # returns the versions of files that the run was started from; the first check calls it, in a
    # thread
    known: Callable[[], Iterable[tuple[str, Identity | None]]] = tuple


def watch_rules(options: RunnerOptions) -> WatchRules:
    """The rules for files that cause a reload; reads the .gitignore files now."""
    root = options.working_directory
    own = frozenset({options.dataflow, settings_path(options.dataflow)})
    watched = options.of_dataflow("watch") or DEFAULT_WATCH
    of_nodes = tuple(options.by_node("watch").values())
    ignored, gitignores = options.of_dataflow("ignore"), read_gitignores(root)
    return WatchRules(root, watched, ignored, gitignores, own, of_nodes)


async def changed_files(
    rules: WatchRules,
    on_seen: Callable[[], object] = bool,
    has_moved: Callable[[], bool] = bool,
    idle_ms: int = IDLE_MS,
    since: Since | None = None,
) -> AsyncIterator[frozenset[str]]:
    """Files that match `rules` and were written, created, renamed or deleted, in batches.

    Watches directories, not files, because editors save by renaming. Ignored directories cost
    nothing. on_seen: is called when each later change is noticed, if not at once. has_moved:
    whether a link leads elsewhere than to the root of the rules; is called from time to time, and
    the root is reported then. idle_ms: as IDLE_MS. since: also report files that were saved between
    this moment and the first look; None: report only later changes. Raises DoraSystemdError if the
    kernel refuses more watches.
    """
    seen = Seen(rules)
    # In a thread: a large tree takes seconds, and the loop of the runner feeds the watchdog.
    early = await asyncio.to_thread(seen.first, since)
    on_seen()
    if early:
        yield early
    while True:
        await _wait_root(rules.root)
        is_unsure = True
        async for paths, is_new in _with_start(rules, idle_ms):
            files = seen.take(path for path in paths if _is_file(rules, path))
            # Found by their identity: changes before the new watches, and those that watchfiles
            # drops because they arrive between its copy of others and the clearing of its list.
            if is_new or (is_unsure and not paths):
                files |= await asyncio.to_thread(seen.missed)
            is_unsure = bool(paths) or is_new
            if not paths and has_moved():
                files |= {rules.root}
            if files:
                yield files
        # Directories came or went.
        if files := await asyncio.to_thread(seen.missed):
            yield files


class Seen:
    """The files that match `rules`, as they were seen last."""

    def __init__(self, rules: WatchRules) -> None:
        self._rules = rules
        self._seen: dict[str, Identity] = {}
        self._gone: set[str] = set()

    def first(self, since: Since | None) -> frozenset[str]:
        """Record the present state of all files. Return those changed since the run began.

        A file whose version at the start is known is compared with that version. Of any other file
        only the time of its last change is known.
        """
        self.missed()
        return frozenset() if since is None else self._changed_since(since)

    def _changed_since(self, since: Since) -> frozenset[str]:
        known = [one for one in since.known() if self._rules.has(one[0])]
        changed = {path for path, one in known if one != self._seen.get(path)}
        # As an age: after the clock is set, files older than the start must not look new.
        now_ns, age_ns = time.time_ns(), time.monotonic_ns() - since.at_ns
        others = self._seen.keys() - {path for path, _ in known}
        late = {path for path in others if 0 <= now_ns - self._seen[path].changed_ns < age_ns}
        return frozenset(changed | late)

    def take(self, paths: Iterable[str]) -> frozenset[str]:
        """Record the present state of `paths`; return the paths."""
        files = frozenset(paths)
        self._note({path: identity(path) for path in files})
        return files

    def missed(self) -> frozenset[str]:
        """Return the files that have changed since the last check, and record their state.

        A file that was removed and restored has not changed, unless it is one of rules.files:
        settings do not apply while their file is missing.
        """
        now = watched_files(self._rules)
        gone = self._seen.keys() - now.keys() - self._gone
        back = self._gone & now.keys() & self._rules.files
        changed = {path for path, one in now.items() if one != self._seen.get(path)}
        self._note({**now, **dict.fromkeys(gone)})
        return frozenset(changed | gone | back)

    def _note(self, found: Mapping[str, Identity | None]) -> None:
        for path, one in found.items():
            if one is None:
                self._gone.add(path)
            else:
                self._seen[path] = one
                self._gone.discard(path)


def _is_file(rules: WatchRules, path: str) -> bool:
    """Whether a change of `path` counts: a pattern can match a directory, too."""
    if not rules.has(path):
        return False
    return path in rules.files or Path(path).is_symlink() or not Path(path).is_dir()


def watched_files(rules: WatchRules) -> dict[str, Identity]:
    """The files that match `rules` now."""
    found = {
        entry.path: identity(entry.path)
        for directory in watched_directories(rules)
        for entry in _entries(directory)
        if rules.has(entry.path) and not entry.is_dir(follow_symlinks=False)
    }
    return {path: one for path, one in found.items() if one is not None}


def watched_directories(rules: WatchRules) -> list[str]:
    """The directories that can contain such files, the top one first."""
    apart = {str(Path(one).parent) for one in rules.files}
    found = [rules.root, *sorted(one for one in apart if not rules.has_directory(one))]
    for directory in found:
        for entry in _entries(directory):
            if entry.is_dir(follow_symlinks=False) and rules.has_directory(entry.path):
                found.append(entry.path)
    return found


def read_gitignores(root: str) -> dict[str, tuple[str, ...]]:
    """The lines of each .gitignore below `root` by relative directory, for WatchRules."""
    found: dict[str, tuple[str, ...]] = {}
    for directory in watched_directories(WatchRules(root)):
        try:
            # Do not follow links, because git does not: see NOTES in gitignore(5).
            data = read_file(Path(directory, ".gitignore")).data
        except DoraSystemdError:
            continue
        lines = data.decode(errors="replace").splitlines()
        found[os.path.relpath(directory, root).removeprefix(".")] = tuple(lines)
    return found


async def _with_start(
    rules: WatchRules, idle_ms: int
) -> AsyncIterator[tuple[frozenset[str], bool]]:
    """Yield the bursts, the first one with True, and before it an early one without paths, too.

    The early burst comes when the watches should exist, the first one when they certainly do. The
    bursts end if a directory has no watch, because it was created after the list was made.
    """
    directories = await asyncio.to_thread(watched_directories, rules)

    async def are_all() -> bool:
        return directories == await asyncio.to_thread(watched_directories, rules)

    bursts = _bursts(rules, directories, idle_ms)
    first = asyncio.ensure_future(anext(bursts))
    try:
        done, _ = await asyncio.wait({first}, timeout=_NEW_SECONDS)
        if not done:
            yield frozenset(), True
            if not await are_all():
                return
        with contextlib.suppress(StopAsyncIteration):
            yield await first, True
            if await are_all():
                async for paths in bursts:
                    yield paths, False
    finally:
        first.cancel()


async def _bursts(
    rules: WatchRules, directories: list[str], idle_ms: int
) -> AsyncGenerator[frozenset[str]]:
    """Paths of changed files, until a directory is created or deleted; none each `idle_ms`."""
    # Imported late: only hot reload needs it.
    from watchfiles import Change, awatch

    before = await asyncio.to_thread(_inodes, directories)
    try:
        async for changes in awatch(
            *directories,
            watch_filter=None,
            debounce=DEBOUNCE_MS,
            step=_STEP_MS,
            rust_timeout=idle_ms,
            yield_on_timeout=True,
            recursive=False,
        ):
            yield frozenset(path for _, path in changes)
            gone = {path for change, path in changes if change is Change.deleted}
            there = (path for _, path in changes if Path(path).is_dir())
            if gone.intersection(directories) or any(map(rules.has_directory, there)):
                return
            # Nothing is reported if a directory above them is replaced.
            if not changes and before != await asyncio.to_thread(_inodes, directories):
                return
    except FileNotFoundError:
        # A directory was removed, such as that of a dataflow file outside of its project.
        await asyncio.sleep(_GONE_SECONDS)
    except OSError as error:
        if error.errno == errno.ENOSPC or "limit" in str(error).lower():
            message = f"cannot watch {rules.root}: the kernel gives no more inotify watches"
            hint = "raise sysctl fs.inotify.max_user_watches, or exclude files with --ignore"
            raise DoraSystemdError(message, hint) from error
        raise DoraSystemdError(f"cannot watch {rules.root}: {words_of(error)}") from error
    except RuntimeError as error:  # from watchfiles: the kernel has no inotify instance left
        hint = "raise sysctl fs.inotify.max_user_instances"
        raise DoraSystemdError(f"cannot watch {rules.root}: {error}", hint) from error


async def _wait_root(root: str) -> None:
    """Wait until a root that was moved away is back."""
    while not Path(root).is_dir():
        await asyncio.sleep(_GONE_SECONDS)


def _inodes(paths: Iterable[str]) -> list[tuple[int, int]]:
    found = (identity(path) for path in paths)
    return [(one.device, one.inode) if one else (0, 0) for one in found]


def _entries(directory: str) -> list["os.DirEntry[str]"]:
    try:
        return sorted(os.scandir(directory), key=lambda entry: entry.name)
    except OSError:
        return []

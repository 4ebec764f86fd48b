"""Watches the files below a directory, by inotify(7). Only this module imports watchfiles."""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path

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
_GONE_SECONDS = 0.25


def watch_rules(options: RunnerOptions) -> WatchRules:
    """The rules for files that cause a reload; reads the .gitignore files now."""
    root, given = options.working_directory, options.reload
    own = frozenset({options.dataflow, settings_path(options.dataflow)})
    watched = given.watch or DEFAULT_WATCH
    return WatchRules(root, watched, given.ignore, read_gitignores(root), own)


async def changed_files(
    rules: WatchRules, on_seen: Callable[[], object] = bool, idle_ms: int = IDLE_MS
) -> AsyncIterator[frozenset[str]]:
    """Files that match `rules` and were written, created, renamed or deleted, in batches.

    Watches directories, not files, because editors save by renaming. Ignored directories cost
    nothing. on_seen: is called when each later change is noticed, if not at once. idle_ms: as
    IDLE_MS. Raises DoraSystemdError if the kernel refuses more watches.
    """
    seen: dict[str, int] = {}

    async def missed() -> frozenset[str]:
        """The files that have changed since they were seen last."""
        # In a thread: a large tree takes seconds, and the loop of the runner feeds the watchdog.
        now = await asyncio.to_thread(watched_files, rules)
        changed = frozenset(path for path in {*seen, *now} if seen.get(path) != now.get(path))
        seen.clear()
        seen.update(now)
        return changed

    await missed()
    on_seen()
    while True:
        await _wait_root(rules.root)
        is_first = is_unsure = True
        async for paths in _bursts(rules, idle_ms):
            files = frozenset(path for path in paths if rules.has(path))
            seen.update((path, change_time(path)) for path in files)
            # Found by their time: changes before the new watches, and those that watchfiles drops
            # because they arrive between its copy of others and the clearing of its list.
            if is_first or (is_unsure and not paths):
                files |= await missed()
            is_first, is_unsure = False, bool(paths)
            if files:
                yield files
        # Directories came or went.
        if files := await missed():
            yield files


def watched_files(rules: WatchRules) -> dict[str, int]:
    """The files that match `rules` now, with their times of change in ns."""
    return {
        entry.path: change_time(entry.path)
        for directory in watched_directories(rules)
        for entry in _entries(directory)
        if rules.has(entry.path) and not entry.is_dir(follow_symlinks=False)
    }


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


def change_time(path: str) -> int:
    """When a file was written or moved there, in ns since the epoch; 0 if it does not exist."""
    try:
        return Path(path).stat().st_ctime_ns
    except OSError:
        return 0


async def _bursts(rules: WatchRules, idle_ms: int) -> AsyncIterator[frozenset[str]]:
    """Paths of changed files, until a directory is created or deleted; none each `idle_ms`."""
    # Imported late: only hot reload needs it.
    from watchfiles import Change, awatch

    directories = await asyncio.to_thread(watched_directories, rules)
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
    except FileNotFoundError:
        # A directory has gone, perhaps for good, as that of a dataflow file apart from its project.
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


def _entries(directory: str) -> list["os.DirEntry[str]"]:
    try:
        return sorted(os.scandir(directory), key=lambda entry: entry.name)
    except OSError:
        return []

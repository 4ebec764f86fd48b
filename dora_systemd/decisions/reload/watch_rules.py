"""Decides which files of a project cause a reload when they change.

Patterns are those of gitignore(5): `*.py` matches any such file, `config/*` everything in the
directory config at the top.
"""

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import PurePath
from typing import TYPE_CHECKING, NamedTuple

from dora_systemd.errors import usage_error
from dora_systemd.values import quoted

if TYPE_CHECKING:
    from pathspec import GitIgnoreSpec

DEFAULT_WATCH = (
    *("*.py", "*.yml", "*.yaml"),
    *("*.toml", "*.json", "*.ini", "*.cfg", "*.conf", ".env"),
)
"""Programs, dataflows and configuration, as in dora's reference page."""

NOT_OF_PROJECT = (
    # Version control, environments and caches.
    *(".git/", ".hg/", ".svn/", "__pycache__/", "venv/", ".venv/", ".dora/", "node_modules/"),
    *("site-packages/", ".tox/", ".nox/", ".*_cache/", ".hypothesis/", "*.egg-info/"),
    # Logs, temporary files, and files that editors create next to the edited file.
    *("*.log", "*.jsonl", "log/", "logs/", "tmp/", "*.tmp", "*.temp", "*.part", "*.bak", "*~"),
    *(".#*", "#*#", "*.sw?", "4913", "*.pyc"),
)
ALWAYS_IGNORED = (
    *NOT_OF_PROJECT,
    # What is built, and data.
    *("build/", "dist/", "target/", "out/"),
    *("data/", "*.csv", "*.parquet", "*.arrow", "*.npy", "*.npz", "*.pt", "*.onnx"),
)


class WatchRules(NamedTuple):
    """The rules of one dataflow."""

    root: str  # absolute directory that patterns are relative to
    watched: tuple[str, ...] = DEFAULT_WATCH  # patterns of files
    ignored: tuple[str, ...] = ()  # patterns that take precedence
    # by directory relative to root, lines of .gitignore
    gitignores: Mapping[str, tuple[str, ...]] = {}
    files: frozenset[str] = frozenset()  # absolute paths that are always watched
    of_nodes: tuple[tuple[str, ...], ...] = ()  # patterns of further files, of single nodes

    def has(self, path: str) -> bool:
        """Whether a change of the file `path` (absolute) causes a reload."""
        relative = self._relative(path)
        is_watched = any(_spec(one).match_file(relative) for one in (self.watched, *self.of_nodes))
        return path in self.files or (is_watched and not self.is_ignored(path))

    def has_directory(self, path: str) -> bool:
        """Whether the directory `path` (absolute) may contain such files."""
        return path == self.root or not self.is_ignored(f"{path}/")

    def is_ignored(self, path: str) -> bool:
        """Whether `path` (absolute) is ignored; a path that ends with / is a directory."""
        relative, ignored = self._relative(path), _spec((*ALWAYS_IGNORED, *self.ignored))
        return not relative or ignored.match_file(relative) or self._gitignores(relative)

    def _relative(self, path: str) -> str:
        """The path relative to root, for patterns; "" if it is not below root."""
        prefix = self.root.rstrip("/") + "/"
        return path.removeprefix(prefix) if path.startswith(prefix) else ""

    def _gitignores(self, relative: str) -> bool:
        for directory, lines in self.gitignores.items():
            prefix = f"{directory}/" if directory else ""
            if relative.startswith(prefix) and _spec(lines).match_file(relative[len(prefix) :]):
                return True
        return False


@cache
def _spec(patterns: tuple[str, ...]) -> "GitIgnoreSpec":
    # Imported late: only hot reload needs it.
    from pathspec import GitIgnoreSpec

    return GitIgnoreSpec.from_lines(filter(_is_pattern, patterns))


def _is_pattern(line: str) -> bool:
    """Whether it is a line of gitignore(5); one that is not matches nothing, as in git."""
    from pathspec import GitIgnoreSpec  # see above

    try:
        GitIgnoreSpec.from_lines([line])
    except (ValueError, re.error):
        return False
    return True


def parse_patterns(texts: Iterable[str]) -> tuple[str, ...]:
    """The patterns in comma-separated lists. Raises DoraSystemdError (USAGE)."""
    patterns = [one.strip() for text in texts for one in text.split(",") if one.strip()]
    for pattern in patterns:
        is_plain = pattern.isprintable() and ".." not in PurePath(pattern).parts
        if not is_plain or not _is_pattern(pattern):
            hint = "write patterns as in gitignore(5), such as *.py or config/*"
            raise usage_error(f"cannot watch {quoted(pattern)}", hint)
    return tuple(patterns)


def relative_patterns(patterns: Iterable[str], root: str) -> tuple[str, ...]:
    """Patterns relative to `root`.

    Raises DoraSystemdError (USAGE) for an absolute pattern that is not below `root`.
    """
    return tuple(_relative_pattern(pattern, root.rstrip("/")) for pattern in patterns)


def _relative_pattern(pattern: str, root: str) -> str:
    if not pattern.startswith("/"):
        return pattern
    if not pattern.startswith(f"{root}/"):
        hint = "watched files are in the working directory; see --working-directory"
        raise usage_error(f"cannot watch {quoted(pattern)}: it is outside of {root}", hint)
    return pattern.removeprefix(root)


def unmatched_patterns(rules: WatchRules, paths: Iterable[str]) -> tuple[str, ...]:
    """The patterns of `rules` that match none of `paths`, for a warning."""
    known = [path for path in paths if not rules.is_ignored(path)]
    return tuple(
        pattern
        for pattern in rules.watched
        if not any(WatchRules(rules.root, (pattern,)).has(path) for path in known)
    )

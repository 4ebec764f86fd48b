"""The settings of hot reload."""

from typing import Any

from dora_systemd.decisions.cell.hot_reload import REPLACE_WORDS
from dora_systemd.decisions.reload.watch_rules import DEFAULT_WATCH, parse_patterns
from dora_systemd.decisions.settings.kinds import BOOL, Base, Kind, Setting, scalar_text, texts_of
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted


def _parse_patterns(value: Any, base: Base) -> tuple[str, ...]:
    del base
    return parse_patterns(scalar_text(one) for one in texts_of(value))


def _parse_replace(value: Any, base: Base) -> str:
    del base
    if value not in REPLACE_WORDS:
        message = f"cannot replace a node {quoted(scalar_text(value))}"
        raise DoraSystemdError(message, f"write {' or '.join(REPLACE_WORDS)}", ExitCode.USAGE)
    return str(value)


PATTERNS = Kind[tuple[str, ...]](
    str | list[str],
    "a pattern such as *.py or a list of them",
    _parse_patterns,
    list,
    is_repeatable=True,
)

HOT_RELOAD = Setting[bool](
    "hot_reload",
    BOOL,
    False,
    "Restart nodes when their files change.",
    flags=("--hot-reload",),
    variable="DORA_HOT_RELOAD",
)
WATCH = Setting[tuple[str, ...]](
    "watch",
    PATTERNS,
    (),
    f"Files that trigger a reload, as in gitignore(5); default: {', '.join(DEFAULT_WATCH)}.",
    flags=("--watch",),
    variable="DORA_WATCH",
    metavar="PATTERN,...",
    per_node=True,
)
IGNORE = Setting[tuple[str, ...]](
    "ignore",
    PATTERNS,
    (),
    "Files that never trigger a reload, besides those that git ignores.",
    flags=("--ignore",),
    variable="DORA_IGNORE",
    metavar="PATTERN,...",
)
REPLACE = Setting[str](
    "replace",
    Kind[str](str, "stop-first or start-first", _parse_replace, lambda value: [value]),
    "stop-first",
    "Whether a reloaded node stops before its replacement starts, or after.",
    flags=("--replace",),
    variable="DORA_REPLACE",
    metavar="HOW",
    per_node=True,
)

RELOAD_SETTINGS: tuple[Setting[Any], ...] = (HOT_RELOAD, WATCH, IGNORE, REPLACE)

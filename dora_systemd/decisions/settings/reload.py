"""The settings of hot reload."""

from typing import Any

from dora_systemd.decisions.reload.watch_rules import (
    DEFAULT_WATCH,
    parse_patterns,
    relative_patterns,
)
from dora_systemd.decisions.settings.kinds import BOOL, Setting, many_texts, one_text
from dora_systemd.errors import usage_error
from dora_systemd.values import quoted

START_FIRST = "start-first"
REPLACE_WORDS = ("stop-first", START_FIRST)
"""What is first when a node gets another process: the end of the old one, or the start."""


def _parse_replace(text: str) -> str:
    if text not in REPLACE_WORDS:
        hint = f"write {' or '.join(REPLACE_WORDS)}"
        raise usage_error(f"cannot replace a node {quoted(text)}", hint)
    return text


PATTERNS = many_texts(
    "a pattern such as *.py or a list of them", "PATTERN,...", parse_patterns, list
)

HOT_RELOAD = Setting[bool]("hot_reload", BOOL, False, "Restart nodes when their files change.")
WATCH = Setting[tuple[str, ...]](
    "watch",
    PATTERNS,
    (),
    f"Files that trigger a reload, as in gitignore(5); default: {', '.join(DEFAULT_WATCH)}.",
    variable="DORA_WATCH",
    per_node=True,
    on_members=False,
    outlives_node=True,
    at_start=relative_patterns,
)
IGNORE = Setting[tuple[str, ...]](
    "ignore",
    PATTERNS,
    (),
    "Files that never trigger a reload, besides those that git ignores.",
    variable="DORA_IGNORE",
    at_start=relative_patterns,
)
REPLACE = Setting[str](
    "replace",
    one_text(str, "stop-first or start-first", "HOW", _parse_replace),
    "stop-first",
    "A reloaded node stops before its replacement starts (stop-first) or after (start-first).",
    per_node=True,
    on_members=False,
    outlives_node=True,
)

RELOAD_SETTINGS: tuple[Setting[Any], ...] = (HOT_RELOAD, WATCH, IGNORE, REPLACE)
RUNNER_SETTINGS = {one.name: one for one in RELOAD_SETTINGS}

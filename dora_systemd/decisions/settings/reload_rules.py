"""Turns settings into the runner's options for hot reload."""

from collections.abc import Iterator

from dora_systemd.decisions.cell.hot_reload import HotReload
from dora_systemd.decisions.reload.watch_rules import relative_patterns
from dora_systemd.decisions.settings.reload import (
    HOT_RELOAD,
    IGNORE,
    RELOAD_SETTINGS,
    REPLACE,
    WATCH,
)
from dora_systemd.decisions.settings.resolve import DEFAULT_SOURCE, Settings


def hot_reload(settings: Settings, root: str) -> HotReload:
    """The options for hot reload; patterns are relative to `root`, the working directory.

    Raises DoraSystemdError (USAGE) for an absolute pattern outside of it.
    """
    watch, ignore = settings[WATCH], settings[IGNORE]
    given = {node: one.get(WATCH.name, ()) for node, one in settings.nodes.items()}
    return HotReload(
        settings[HOT_RELOAD],
        relative_patterns(watch, root),
        relative_patterns(ignore, root),
        tuple((node, one) for node in given for one in relative_patterns(given[node], root)),
        tuple(_replace_words(settings)),
    )


def _replace_words(settings: Settings) -> Iterator[tuple[str, str]]:
    if settings.source(REPLACE) != DEFAULT_SOURCE:
        yield "", settings[REPLACE]
    for node, given in settings.nodes.items():
        if REPLACE.name in given:
            yield node, given[REPLACE.name]


def reload_warnings(settings: Settings) -> Iterator[str]:
    """A warning for each hot reload setting that has no effect because it is off."""
    if settings[HOT_RELOAD]:
        return
    for setting in RELOAD_SETTINGS:
        if setting not in (HOT_RELOAD, REPLACE) and settings.source(setting) != DEFAULT_SOURCE:
            yield f"{setting.flags[0]} has no effect without {HOT_RELOAD.flags[0]}"

"""What a runner is told about reloads: which files it watches, and how it replaces a node.

It is part of the runner's command line, which `list` reads: nothing here costs time.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.suggestions import missing_node

START_FIRST = "start-first"
REPLACE_WORDS = ("stop-first", START_FIRST)

CHANGE_VARIABLE = "DORA_SYSTEMD_HOT_RELOAD"
"""Tells the runner what `doractl set --hot-reload` has changed since the unit was made."""

ARGUMENTS = ("watch", "ignore", "node-watch", "replace")
"""Repeatable options of the runner."""


class HotReload(NamedTuple):
    """is_on: whether files are watched at all. watch, ignore: patterns as in gitignore(5), none
    for the usual ones. node_watch: more of them, of single nodes. replace: one of REPLACE_WORDS by
    node, "" for all others.
    """

    is_on: bool = False
    watch: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    node_watch: tuple[tuple[str, str], ...] = ()
    replace: tuple[tuple[str, str], ...] = ()

    def starts_first(self, node: str) -> bool:
        """Whether the successor of `node` starts before it ends."""
        words = dict(self.replace)
        return words.get(node, words.get("", "")) == START_FIRST

    def watched_by(self, node: str) -> tuple[str, ...]:
        """The node's own patterns."""
        return tuple(pattern for one, pattern in self.node_watch if one == node)


DEFAULT_RELOAD = HotReload()


class SettingsChange(NamedTuple):
    """What has changed in a settings file.

    limits: those of nodes. others: keys that take effect with the next start.
    """

    limits: tuple[NodeLimits, ...]
    others: tuple[str, ...]


def format_reload(reload: HotReload) -> list[tuple[str, str]]:
    """The options of the runner and their values; whether it is on is a flag of its own."""
    nodes = [("node-watch", f"{node}={pattern}") for node, pattern in reload.node_watch]
    words = [("replace", f"{node}={word}") for node, word in reload.replace]
    watch = [("watch", one) for one in reload.watch]
    return [*watch, *(("ignore", one) for one in reload.ignore), *nodes, *words]


def parse_reload(is_on: bool, given: Mapping[str, Sequence[str]]) -> HotReload:
    """The exact inverse of format_reload; `given` has the values of ARGUMENTS."""
    return HotReload(
        is_on,
        tuple(given["watch"]),
        tuple(given["ignore"]),
        tuple(map(_pair, given["node-watch"])),
        tuple(map(_pair, given["replace"])),
    )


def _pair(text: str) -> tuple[str, str]:
    # Ids of nodes have no "=".
    node, _, value = text.partition("=")
    return node, value


def check_reload_nodes(reload: HotReload, nodes: Sequence[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that is none of `nodes`."""
    for node in (*dict(reload.node_watch), *filter(None, dict(reload.replace))):
        if node not in nodes:
            raise missing_node("cannot watch files of", node, nodes)

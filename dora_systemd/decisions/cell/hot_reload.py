"""The runner's options for hot reload: the files to watch, and how to replace a node.

They are part of the runner's command line, which `list` parses: imports only what loads quickly.
"""

from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.names import check_known

START_FIRST = "start-first"
REPLACE_WORDS = ("stop-first", START_FIRST)

CHANGE_VARIABLE = "DORA_SYSTEMD_HOT_RELOAD"
"""Passes changes by `doractl set --hot-reload` since the unit was created to the runner."""


class HotReload(NamedTuple):
    """Options of hot reload."""

    is_on: bool = False  # whether files are watched at all
    # watch, ignore: patterns as in gitignore(5), empty for the defaults
    watch: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    node_watch: tuple[tuple[str, str], ...] = ()  # additional patterns of single nodes
    # by node, one of REPLACE_WORDS; the key "" is for all other nodes
    replace: tuple[tuple[str, str], ...] = ()

    def starts_first(self, node: str) -> bool:
        """Whether the new process of `node` starts before the old one ends."""
        words = dict(self.replace)
        return words.get(node, words.get("", "")) == START_FIRST

    def watched_by(self, node: str) -> tuple[str, ...]:
        """The node's own patterns."""
        return tuple(pattern for one, pattern in self.node_watch if one == node)


DEFAULT_RELOAD = HotReload()


def parse_of_node(text: str) -> tuple[str, str]:
    """Node and value of NODE=VALUE, as the runner's command line has them. Ids contain no "="."""
    node, _, value = text.partition("=")
    return node, value


def check_reload_nodes(reload: HotReload, nodes: Sequence[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that is not in `nodes`."""
    named = (*dict(reload.node_watch), *filter(None, dict(reload.replace)))
    check_known("cannot watch files of", named, nodes)

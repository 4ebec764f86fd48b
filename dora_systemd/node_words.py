"""Texts about one node, NODE:WORD=VALUE,WORD=VALUE, as --node-limit and --node-rights take them.

The runner's command line contains them, so this module imports only what loads quickly.
"""

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted

V = TypeVar("V")

_BETWEEN = re.compile(r",(?![0-9])")
"""The comma between assignments. Lists such as cpus=0,2-3 have commas in front of digits."""


class NodeWords(NamedTuple):
    """What such a text is about."""

    # singular, plural: for messages
    singular: str
    plural: str
    example: str  # assignments


def parse_node_words(
    text: str, about: NodeWords, parsers: Mapping[str, Callable[[str], V]]
) -> tuple[str, dict[str, V]]:
    """The node, and the values by word. Raises DoraSystemdError (USAGE)."""
    # Values may contain a colon, node ids contain none.
    node, _, assignments = text.partition(":")
    if not node or not assignments:
        raise refusal(f"{quoted(text)} as {about.plural} of a node", f"write NODE:{about.example}")
    values: dict[str, V] = {}
    for assignment in _BETWEEN.split(assignments):
        word, _, value = assignment.partition("=")
        if word not in parsers:
            hint = did_you_mean(word, parsers) or f"valid values: {', '.join(parsers)}"
            raise refusal(
                f"{quoted(assignment)} as {about.singular} of the node {quoted(node)}", hint
            )
        if word in values:
            raise refusal(f"{quoted(text)}: {word} is given twice", "leave one of them out")
        values[word] = parsers[word](value)
    return node, values


def refusal(what: str, hint: str) -> DoraSystemdError:
    """The error for a text that cannot be used."""
    return DoraSystemdError(f"cannot use {what}", hint, ExitCode.USAGE)

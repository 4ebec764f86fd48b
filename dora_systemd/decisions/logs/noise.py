"""Finds lines not worth showing: repeated ones, and those that an event covers already. Pure."""

import re
from collections.abc import Collection

_TIME = rb"(?:\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d(?:[.,]\d+)?"
_EXIT_OF_A_NODE = b"node_failure: dora_daemon::"
"""Part of a line of dora's daemon about an end that node-crashed, -ended or -exited reports."""
_END_OF_NODE = r"node_failure: .*\bnode_id=(\S+)"


def is_same(one: bytes, other: bytes) -> bool:
    """Whether two lines differ at most in the digits of times."""
    if one == other:
        return True
    if len(one) != len(other) or b":" not in one:
        return False
    return re.sub(_TIME, b"", one) == re.sub(_TIME, b"", other)


def repeated(text: str, times: int) -> str:
    """Format the text below a line that occurred `times` times; "" for once."""
    if times < 3:
        return text * (times - 1)
    return f"... the same line, {times} times in all"


def is_end_of(text: str, nodes: Collection[str], prefixes: tuple[str, ...] = ()) -> bool:
    """Return whether a recorded line of dora's daemon reports that one of `nodes` has failed.

    prefixes: of the ids of further nodes.
    """
    match = re.search(_END_OF_NODE, text) if nodes or prefixes else None
    return match is not None and (match[1] in nodes or match[1].startswith(prefixes))


def is_told_by_event(origin: bytes, text: bytes) -> bool:
    """Return whether a line reports the end of a node, which a life event reports too.

    origin: "daemon", or with the name of the dataflow before a slash.
    """
    return _EXIT_OF_A_NODE in text and origin.rpartition(b"/")[2] == b"daemon"

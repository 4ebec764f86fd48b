"""Whether the nodes of a member run the same files as there are on the head. Pure.

A member tells the digests of its programs, and of what these import, by their path relative to the
dataflow file. A file that the head does not have says nothing: it may be for that machine only.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from dora_systemd.terminal_text import short_line

MOST_FILES = 500
_NAMED = 3
_LONGEST = 100
_DIGEST = 64
"""Hexadecimal digits of SHA-256."""

Digests = Mapping[str, str]
"""SHA-256 by relative path."""


def format_digests(digests: Digests) -> str:
    """The text for wire.Programs."""
    return json.dumps(dict(list(digests.items())[:MOST_FILES]))


def parse_digests(text: str) -> dict[str, str]:
    """The digests of a member, which can lie: without what is no path below the dataflow file.

    Raises ValueError for another text.
    """
    found = json.loads(text)
    if not isinstance(found, dict):
        raise ValueError(text)
    return {path: one for path, one in list(found.items())[:MOST_FILES] if _is_digest(path, one)}


def _is_digest(path: str, digest: object) -> bool:
    is_hex = isinstance(digest, str) and len(digest) == _DIGEST
    pure = PurePosixPath(path)
    return is_hex and "\0" not in path and not pure.is_absolute() and ".." not in pure.parts


def differing(here: Digests, there: Digests) -> list[str]:
    """The files that both machines have, and that are not the same."""
    return sorted(path for path, one in there.items() if here.get(path, one) != one)


def format_differing(found: Mapping[str, Sequence[str]]) -> str:
    """One line for people; "" if nothing differs. found: by machine."""
    parts = (
        f"machine {machine} runs another {_names(files)} than the one here"
        for machine, files in found.items()
        if files
    )
    return "; ".join(parts)


def _names(files: Sequence[str]) -> str:
    names = ", ".join(short_line(one, _LONGEST) for one in files[:_NAMED])
    more = len(files) - _NAMED
    return f"{names} and {more} more" if more > 0 else names

"""Versions of the programs that a release was checked with. Pure.

The check prints them as the user of the nodes, whose programs they are: they are only shown.
"""

import re
from collections.abc import Mapping

PROGRAMS = ("dora", "python")
"""The programs whose versions are checked."""
_MARK = "versions:"
_VERSION = r"[0-9][0-9A-Za-z.+~-]{0,31}"


def format_versions(versions: Mapping[str, str]) -> str:
    """The line of a check, as "versions: dora=1.1.0 python=3.13.5"."""
    known = (f"{name}={versions[name]}" for name in PROGRAMS if versions.get(name))
    return " ".join([_MARK, *known])


def parse_versions(text: str) -> dict[str, str]:
    """Parse the versions that a check has printed; other text is left out."""
    line = next((line for line in text.splitlines() if line.startswith(_MARK)), "")
    pairs = (word.partition("=")[::2] for word in line.removeprefix(_MARK).split())
    return {name: one for name, one in pairs if name in PROGRAMS and re.fullmatch(_VERSION, one)}

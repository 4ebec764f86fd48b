"""Whether to write colours: the rules of systemd(1)."""

import os
from collections.abc import Mapping
from typing import TextIO

from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import parse_bool


def is_dumb(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether the terminal cannot move its cursor or show colours."""
    return environ.get("TERM", "dumb") in ("", "dumb")


def wants_colors(stream: TextIO, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether output to `stream` is coloured.

    $SYSTEMD_COLORS decides: a boolean, or a number of colours. Else there are colours on a terminal
    that has them, unless $NO_COLOR is set.
    """
    given = environ.get("SYSTEMD_COLORS", "")
    if given and not given.startswith("auto"):
        try:
            return (given.isdecimal() and int(given) > 1) or parse_bool(given)
        except (DoraSystemdError, ValueError):
            pass  # systemd ignores a word that it does not know
    return stream.isatty() and not is_dumb(environ) and not environ.get("NO_COLOR")

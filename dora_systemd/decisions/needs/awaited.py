"""What the start of a dataflow waits for, in the words of `needs`. Pure."""

import re
from collections.abc import Iterable

from dora_systemd.decisions.cell.needs import CLOCK, NETWORK
from dora_systemd.decisions.needs.units import CLOCK_UNIT, CLOCK_WAITERS, NETWORK_UNIT
from dora_systemd.names import name_from_unit

_MOST = 3
"""Needs that are named."""
_OF_ALL = ("basic.target", "sysinit.target", "systemd-journald.socket")
"""Units for which systemd lets all services wait during the boot; the slice is one, too."""
_MOUNT = ".mount"
_ESCAPED = re.compile(rb"\\x([0-9a-f]{2})|-")


def format_awaited(units: Iterable[str]) -> str:
    """As "dataflow base, network"; "" without any. units: whose jobs the start waits for.

    Units for which all services wait are named only if there is no other one.
    """
    known = sorted(units)
    words = list(dict.fromkeys(map(_need_word, own_units(known) or known)))
    more = len(words) - _MOST
    return ", ".join(words[:_MOST]) + (f" and {more} more" if more > 0 else "")


def own_units(units: Iterable[str]) -> list[str]:
    """Those of them for which not all services wait."""
    return [one for one in units if one not in _OF_ALL and not one.endswith(".slice")]


def _need_word(unit: str) -> str:
    """The need that a unit stands for, else the unit."""
    if unit == NETWORK_UNIT:
        return NETWORK
    if unit in (CLOCK_UNIT, *CLOCK_WAITERS):
        return CLOCK
    if name := name_from_unit(unit):
        return f"dataflow {name}"
    return f"mount {_unescaped(unit.removesuffix(_MOUNT))}" if unit.endswith(_MOUNT) else unit


def _unescaped(name: str) -> str:
    """As systemd-escape(1) --unescape --path."""
    parts = _ESCAPED.sub(lambda match: bytes.fromhex((match[1] or b"2f").decode()), name.encode())
    return f"/{parts.decode(errors='replace').lstrip('/')}"

"""What the journal has of warnings that nobody expects."""

import json
from collections.abc import Callable, Iterable

from tests.system.cells import journalctl
from tests.system.tolerated import is_tolerated

Journalctl = Callable[..., str]
"""Runs journalctl with these words; what it prints."""


def end_of_journal(ask: Journalctl = journalctl) -> str:
    """The cursor of the last record."""
    return ask("-n", "0", "--show-cursor").rpartition("-- cursor: ")[2].strip()


def complaints(cursor: str, expected: Iterable[str], ask: Journalctl = journalctl) -> list[str]:
    """Warnings and errors of units of dataflows, and of links, since then."""
    lines = ask("-o", "json", "--priority", "warning", f"--after-cursor={cursor}").splitlines()
    records = [json.loads(line) for line in lines]
    ours = [one for one in records if _is_ours(one.get("_SYSTEMD_UNIT", "") + one.get("UNIT", ""))]
    found = [f"{one.get('SYSLOG_IDENTIFIER')}: {one.get('MESSAGE')}" for one in ours]
    known = tuple(expected)
    return [one for one in found if not is_tolerated(one) and not any(k in one for k in known)]


def _is_ours(units: str) -> bool:
    return "dora-" in units or "doralink-" in units

"""The dataflows that a reboot has to bring back, and where their UUIDs are noted in between."""

import json
from pathlib import Path
from typing import Any

from tests.deb import packages
from tests.system.cells import run

NOTES = Path("/var/lib/dora-systemd-boot.json")
ALICE, ROOT = packages.caller("alice"), packages.caller("root")
VENV = Path("/opt/boot")
"""Of the nodes: it has their modules, but no dora command."""


def doractl(*words: str) -> str:
    """What the doractl that is installed says to root."""
    return run(*ROOT, "doractl", *words).stdout


def listed(caller: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Rows of `list --all` by name, as `caller` sees them."""
    rows = json.loads(run(*caller, "doractl", "list", "--all", "-o", "json").stdout)
    return {row["name"]: row for row in rows if row["enabled"]}

"""The dataflows that a reboot has to bring back, and where their UUIDs are noted in between."""

import json
from pathlib import Path
from typing import Any

from tests.system.cells import run

NOTES = Path("/var/lib/dora-systemd-boot.json")
ALICE = ("runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000")
ROOT = ()


def listed(caller: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Rows of `list --all` by name, as `caller` sees them."""
    rows = json.loads(run(*caller, "doractl", "list", "--all", "-o", "json").stdout)
    return {row["name"]: row for row in rows if row["enabled"]}

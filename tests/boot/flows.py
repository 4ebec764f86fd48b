"""The dataflows that a reboot has to bring back, and where their UUIDs are noted in between."""

import json
from pathlib import Path
from typing import Any

from tests.deb import packages
from tests.system.cells import run
from tests.system.typed import Shell, replay

NOTES = Path("/var/lib/dora-systemd-boot.json")
ALICE, ROOT = packages.caller("alice"), packages.caller("root")
VENV = Path("/opt/boot")
"""Of the nodes: it has their modules, but no dora command."""

ROBOT = Path("/srv/robot")
BEFORE, AFTER = (
    (packages.CHECKOUT / "tests/system/transcripts/reboot.txt").read_text().split("$ reboot\n")
)
"""What a person types before and after the reboot."""


def check_typed(text: str) -> None:
    """The lines of that, as root types them beside the robot, show what they should."""
    shell = Shell(ROOT, ROBOT)
    wrong = replay(shell, text)
    shell.end()
    assert not wrong, "reboot.txt differs:\n" + "".join(wrong)


def doractl(*words: str) -> str:
    """What the doractl that is installed says to root."""
    return run(*ROOT, "doractl", *words).stdout


def listed(caller: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Rows of `list --all` by name, as `caller` sees them."""
    rows = json.loads(run(*caller, "doractl", "list", "--all", "-o", "json").stdout)
    return {row["name"]: row for row in rows if row["enabled"]}

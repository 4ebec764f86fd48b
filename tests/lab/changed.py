"""The unit tests that mirror the files that have changed."""

import subprocess
from collections.abc import Iterable
from pathlib import Path

from lab.definition import CHECKOUT

UNIT = Path("tests/unit")
# Where the tests of a source folder are; the longest prefix wins.
MIRRORS = {"dora_systemd": UNIT, "cli": UNIT / "cli", "tests/unit": UNIT}
# What has no mirror (manuals, examples, packaging) is checked there.
REST = UNIT / "project"


def changed_rooms() -> list[str]:
    """Folders of unit tests for what is not committed, or else for the last commit."""
    found = read_git("status", "--porcelain", "--no-renames", "-z", "--untracked-files=all")
    paths = [entry[3:] for entry in found.split("\0") if entry]
    return find_rooms(paths or read_git("diff", "--name-only", "-z", "HEAD~1").split("\0"))


def read_git(*arguments: str) -> str:
    """Output of git in the checkout; empty where there is no git or no history."""
    command = ["git", "-C", str(CHECKOUT), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout
    except OSError:
        return ""


def find_rooms(paths: Iterable[str]) -> list[str]:
    return sorted({str(find_room(Path(path))) for path in paths if path})


def find_room(path: Path) -> Path:
    for source, mirror in MIRRORS.items():
        if path.is_relative_to(source):
            return mirror / path.relative_to(source).parent
    return REST

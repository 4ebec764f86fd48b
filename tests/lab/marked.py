"""Which files have tests of a mark: only these are read on a machine that takes its time for it.

An emulated processor takes a minute to read all system tests, of which six are for it.
"""

from pathlib import Path

SYSTEM = Path(__file__).resolve().parents[1] / "system"


def marked_files(mark: str, place: Path = SYSTEM) -> list[Path]:
    """Test files that say `mark.NAME`, or whose conftest.py beside them does."""
    found = set[Path]()
    for path in place.rglob("*.py"):
        if f"mark.{mark}" in path.read_text(encoding="utf-8"):
            found |= {path} if path.name.startswith("test_") else {*path.parent.glob("test_*.py")}
    return sorted(found)

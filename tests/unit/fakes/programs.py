"""Programs that are scripts of the shell."""

from pathlib import Path


def make_program(path: Path, text: str = "") -> str:
    """A program at `path`, which it returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def make_dora(path: Path, version: str) -> str:
    """A dora that has a version and validates, and records in PATH.asked what it is asked."""
    return make_program(
        path,
        f"""echo "$1" >> "$0.asked"
case $1 in
    --version) echo dora-cli {version};;
    validate) grep -q refused "$2" && {{ echo "[ERROR]"; echo "it is refused" >&2; exit 1; }};;
esac
exit 0
""",
    )

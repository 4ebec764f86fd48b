"""What `doractl start` refuses: one line and a hint, the exit status, and nothing left behind."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run


def units() -> list[str]:
    """All units of dataflows that systemd knows."""
    listed = run("systemctl", "list-units", "--all", "--plain", "--no-legend", "dora-*.service")
    return [line.split()[0] for line in listed.stdout.splitlines()]


def files_of(*places: Path) -> set[str]:
    """Every file below the places."""
    return {str(path) for place in places for path in place.rglob("*")}


IN_THE_JOURNAL = ("failed: cannot ", "Failed with result 'exit-code'", "Failed to start ")
"""What the journal keeps of a dataflow that its runner refuses, dora's checks being made there."""


class Refusal(NamedTuple):
    """Words behind `start`, the exit status, and a part of what is said about it."""

    words: list[str]
    code: ExitCode
    part: str


def check_refusals(cell: Cell, project: Project, refusals: Sequence[Refusal]) -> None:
    """Each is refused in one line and a hint, and nothing is left of any."""
    places = (project.root, Path("/run/dora-systemd"))
    files, before = files_of(*places), units()
    for one in refusals:
        check_refusal(cell, one)
    assert files_of(*places) == files
    assert units() == before


def check_refusal(cell: Cell, refusal: Refusal) -> None:
    words = refusal.words
    name = [] if any(word.startswith("--name") for word in words) else ["--name", cell.name]
    done = cell.doractl("start", *words, *name, check=False)
    lines = done.stderr.splitlines()
    assert done.returncode == refusal.code, (words, done.stderr)
    assert done.stdout == "", words
    assert len(lines) == 2, (words, lines)
    assert lines[0].startswith("doractl: cannot "), words
    assert refusal.part in done.stderr, (words, done.stderr)
    assert lines[1].startswith("hint: "), words

"""Reads what the nodes of a dataflow can write: the files in the RuntimeDirectory of its unit.

That directory belongs to the nodes' user, so a node can replace any file that the runner wrote
there. `list` shows all dataflows together: a bad file of one must not hide the others.
"""

from pathlib import Path

from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import TABLE, CellPaths
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import refusal

MAX_TABLE = 2 * 1024 * 1024
"""Maximum bytes of a node table; one of 2000 nodes is smaller."""
_NOT_THERE = (FileNotFoundError, NotADirectoryError, PermissionError)


def read_table(directory: Path) -> CellStatus | None:
    """The node table in a RuntimeDirectory; None if it is missing or the caller may not read it.

    Raises DoraSystemdError (BAD_INPUT) if the owner of the table does not own the directory, and
    DoraSystemdError for content that no runner writes.
    """
    data = _read(f"{directory}/{TABLE}", MAX_TABLE)
    return None if data is None else CellStatus.from_json(data)


def read_times(directory: Path, size: int) -> bytes:
    """The file of times in a RuntimeDirectory; b"" if it is not usable, or has more than `size`.

    decisions/owes/probe.py says what is in it.
    """
    try:
        return _read(CellPaths(directory).times, size) or b""
    except DoraSystemdError:
        return b""


def _read(path: str | Path, most: int) -> bytes | None:
    """A file that the owner of its directory owns, or None. Raises DoraSystemdError."""
    try:
        text = read_file(path, most)
    except DoraSystemdError as error:
        if isinstance(error.__cause__, _NOT_THERE):
            return None
        raise
    if text.place.borrowed:
        reason = f"it is not of the user whose dataflow it is: {text.place.borrowed}"
        raise refusal(path, reason, "another user put it there")
    return text.data

"""Reads what the nodes of a dataflow can write: the files in the RuntimeDirectory of its unit.

That directory belongs to the nodes' user, so a node can replace any file that the runner wrote
there. `list` shows all dataflows together: a bad file of one must not hide the others.
"""

from pathlib import Path

from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.trust.files import read_file
from dora_systemd.values import shown

MAX_TABLE = 2 * 1024 * 1024
"""Maximum bytes of a node table; one of 2000 nodes is smaller."""
_NOT_THERE = (FileNotFoundError, NotADirectoryError, PermissionError)


def read_cell_file(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of a cell, at most `max_bytes`; its owner must own the directory.

    Raises DoraSystemdError (BAD_INPUT), whose cause is the OSError, if there is one.
    """
    text = read_file(path, max_bytes)
    if text.place.borrowed:
        reason = f"it is not of the user whose dataflow it is: {text.place.borrowed}"
        message = f"cannot read {shown(str(path))}: {reason}"
        raise DoraSystemdError(message, "another user put it there", ExitCode.BAD_INPUT)
    return text.data


def read_table(directory: Path) -> CellStatus | None:
    """The node table in a RuntimeDirectory; None if it is missing or the caller may not read it.

    Raises DoraSystemdError for content that no runner writes.
    """
    try:
        return CellStatus.from_json(read_cell_file(CellPaths(directory).status, MAX_TABLE))
    except DoraSystemdError as error:
        if isinstance(error.__cause__, _NOT_THERE):
            return None
        raise

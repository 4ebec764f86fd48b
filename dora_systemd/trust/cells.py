"""What the nodes of a dataflow can write: the files below the RuntimeDirectory of its unit.

That directory belongs to the nodes' user. A node can put anything in the place of what its runner
wrote, and all dataflows are in one list: whatever is there, the others must be shown.
"""

from pathlib import Path

from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.trust.files import read_file
from dora_systemd.values import shown

MAX_TABLE = 2 * 1024 * 1024
"""Bytes of a node table; one of 2000 nodes has less."""
_NOT_THERE = (FileNotFoundError, NotADirectoryError, PermissionError)


def read_cell_file(path: Path, max_bytes: int) -> bytes:
    """A regular file of a cell, at most `max_bytes`, of the user whose RuntimeDirectory it is in.

    Raises DoraSystemdError (BAD_INPUT), whose cause is the OSError where there was one.
    """
    text = read_file(path, max_bytes)
    if text.place.borrowed:
        reason = f"it is not of the user whose dataflow it is: {text.place.borrowed}"
        message = f"cannot read {shown(str(path))}: {reason}"
        raise DoraSystemdError(message, "another user put it there", ExitCode.BAD_INPUT)
    return text.data


def read_table(directory: Path) -> CellStatus | None:
    """The node table in a RuntimeDirectory; None before there is one, and for who may not read it.

    Raises DoraSystemdError for anything that no runner writes.
    """
    try:
        return CellStatus.from_json(read_cell_file(CellPaths(directory).status, MAX_TABLE))
    except DoraSystemdError as error:
        if isinstance(error.__cause__, _NOT_THERE):
            return None
        raise

"""`doractl show` and `export`: the unit of a dataflow, from the files that systemd has."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.files import decoded
from dora_systemd.decisions.unit.file import persistent_unit, plain_target
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.start.enable import no_unit_file, refuse_attached

_PROPERTIES = ("FragmentPath", "DropInPaths")


def unit_files(manager: Manager, cell: Cell) -> dict[str, str]:
    """Texts of the unit's files by path, drop-ins after the unit file, as in systemctl cat.

    A transient unit has a file too: systemd writes it below /run.
    """
    places = manager.read(cell.unit, _PROPERTIES)
    paths = [path for path in (places["FragmentPath"], *places["DropInPaths"]) if path]
    return {path: _read(path) for path in paths}


def format_unit_files(files: dict[str, str]) -> str:
    """The files in sequence, each after a comment with its path."""
    return "\n".join(f"# {path}\n{text.rstrip()}\n" for path, text in files.items())


def _read(path: str) -> str:
    try:
        return decoded(Path(path).read_bytes(), Path(path))
    except OSError as error:
        raise DoraSystemdError(
            f"cannot read the unit file {path}: {error.strerror}",
            "use sudo" if isinstance(error, PermissionError) else "systemctl daemon-reload",
            ExitCode.NO_PERMISSION if isinstance(error, PermissionError) else ExitCode.FAILURE,
        ) from error


def export_cell(manager: Manager, scope: Scope, cell: Cell) -> str:
    """The unit as one file, with its drop-ins in it. Raises DoraSystemdError."""
    refuse_attached(cell)
    if cell.options.placed:
        raise no_unit_file(cell.name, "it runs on several machines")
    texts = list(unit_files(manager, cell).values())
    return persistent_unit(texts, cell.options, scope.is_user, plain_target(scope.is_user))

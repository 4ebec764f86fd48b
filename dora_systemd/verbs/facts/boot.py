"""Judges whether systemd can start a dataflow: at boot, for `doractl doctor`, and now."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import read_unit_file
from dora_systemd.decisions.unit.file import program_of, runner_of
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.views.rows import begin_anew
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import release_of
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import is_absent
from dora_systemd.values import shown
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import enabled_units


def judge_enabled(path: Path, scope: Scope) -> Iterator[Finding]:
    """Yield what keeps an enabled unit file from starting its dataflow."""
    try:
        text = read_unit_file(path)
    except DoraSystemdError as error:
        yield Finding("boot", State.WARNING, error.message, error.hint)
        return
    options = runner_of(text or "")
    if text is None or options is None:
        broken = "is gone" if text is None else "starts no dataflow"
        remedy = f"systemctl {scope.flag} disable {path.name}"
        yield Finding("boot", State.WARNING, f"{path} is enabled and {broken}", remedy)
    elif is_absent(options.dataflow):
        text = f"{options.name} is enabled, but {options.dataflow} does not exist"
        yield Finding("boot", State.WARNING, text, f"doractl disable {options.name}")
    elif reason := _hindrance(text):
        found = f"{options.name} cannot start at boot: {reason}"
        release = release_of(options.dataflow)
        remedy = begin_anew(options.name, options.dataflow, release, is_enabled=True)
        yield Finding("boot", State.WARNING, found, remedy)


def _hindrance(text: str) -> str:
    """The reason why a unit file of ours cannot be executed, or ""."""
    if runner_of(text, can_start=True) is None:
        return "another version has enabled it"
    program = program_of(text)
    return f"{program} does not exist" if is_absent(program) else ""


def lost_program(
    manager: Manager, scope: Scope, cell: Cell, commands: Sequence[Any] | None, verb: str
) -> DoraSystemdError | None:
    """The error for a Python that is gone, as when doractl was installed in another way since.

    commands: ExecStart= of the unit, see org.freedesktop.systemd1(5). verb: "start" or "restart".
    """
    program = next((one[0] for one in commands or ()), "")
    if not is_absent(program):
        return None
    how = f"doractl stop {cell.name}, then doractl start {cell.name}"
    # The name of an enabled one starts its unit file, which has that Python, too.
    if (is_enabled := cell.unit in enabled_units(manager, scope)) or cell.release:
        how = begin_anew(cell.name, cell.options.dataflow, cell.release, is_enabled, cell.has_begun)
    kept = f"{cell.name} keeps running; instead: " if cell.has_begun else ""
    message = f"cannot {verb} {cell.name}: {shown(program)}, which executes it, does not exist"
    return bad_input(message, f"{kept}{how}")

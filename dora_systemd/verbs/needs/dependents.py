"""Finds the dataflows that need other ones: systemd stops and restarts them together.

See Requires= in systemd.unit(5), and decisions/needs/units.py.
"""

from collections.abc import Sequence

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.outcome import Subject
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells


def find_dependents(manager: Manager, cells: Sequence[Cell]) -> list[Cell]:
    """The running dataflows that need one of `cells`, or need one that does, without `cells`."""
    needed, waiting = {cell.unit for cell in cells}, [cell.unit for cell in cells if cell.is_up]
    found: set[str] = set()
    while waiting:
        by = set(manager.read(waiting.pop(), ["RequiredBy"])["RequiredBy"] or ())
        new = by - found - needed
        found |= new
        waiting += sorted(new)
    if not found:
        return []
    return proven(one for one in read_cells(manager) if one.unit in found and one.is_up)


def format_dependents(needed: Sequence[Subject], dependents: Sequence[Subject]) -> str:
    """As "needy needs base and ends with it"; "" without any."""
    if not dependents:
        return ""
    names, bases = (", ".join(one.name for one in some) for some in (dependents, needed))
    verb, end = ("needs", "ends") if len(dependents) == 1 else ("need", "end")
    return f"{names} {verb} {bases} and {end} with {'it' if len(needed) == 1 else 'them'}"

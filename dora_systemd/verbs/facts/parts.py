"""Parts of a dataflow whose head is another machine: only the head changes the whole."""

from collections.abc import Iterable

from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.facts.cells import Cell

CONTROL = "control"
"""What is done to single nodes, or by the dora command: no verb has this name."""


def refuse_parts(cells: Iterable[Cell], verb: str) -> None:
    """Raise DoraSystemdError (FAILURE) for a part, which names the machine to go to."""
    for cell in cells:
        machine, head = cell.options.machine, cell.options.head
        if machine:
            message = (
                f"cannot {verb} {cell.name} here: this is its part on machine {machine}, "
                f"and the head is {head or 'another machine'}"
            )
            there = f"on {head}" if head else "on the head"
            hint = f"{there}: doractl {verb} {cell.name}"
            raise DoraSystemdError(message, f"use doractl {there}" if verb == CONTROL else hint)


def without_parts(cells: Iterable[Cell]) -> list[Cell]:
    """The dataflows of which this machine is not only a member."""
    return [cell for cell in cells if not cell.options.machine]

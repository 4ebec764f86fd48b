"""Begins the watch over what nodes owe. Imports the rest only for a dataflow that asks for it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dora_systemd.adapters.dora.preparation import Prepared
    from dora_systemd.runner.cell.engine import Engine
    from dora_systemd.runner.cell.failure import Tasks
    from dora_systemd.runner.reload.apply import Run


def begin_watch(run: "Run", prepared: "Prepared", dora: "Engine", dialogue: "Tasks") -> None:
    """Watch the outputs that the options of `prepared` name, if any, until the run ends."""
    if prepared.plan.options.owes:
        from dora_systemd.runner.owes.watch import watch_owes

        dialogue.spawn("watch what nodes owe", watch_owes(run, prepared, dora, dialogue))

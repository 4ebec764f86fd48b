"""Requests a notice while the dataflow runs: a node is given up, or a machine is lost.

The runner may start no unit. It writes a file into a directory that doranotice@NAME.path watches.
"""

from collections.abc import Callable
from pathlib import Path

from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.given_up import given_up
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.logs.journal_events import GIVEN_UP
from dora_systemd.runner.cell.failure import say


def notice_watch(file: Path, pipes: LogPipes) -> Callable[[life.Event, Cell, Cell], None]:
    """Return what the pump calls after each event, with the cells before and after it."""

    def look(event: life.Event, before: Cell, after: Cell) -> None:
        nodes = given_up(before, after)
        for node, reason in nodes.items():
            pipes.write_event(GIVEN_UP, node, reason=reason)
        is_lost = isinstance(event, life.MachineLost) and not event.by and after is not before
        if nodes or is_lost:
            request(file)

    return look


def request(file: Path) -> None:
    """Request a notice, after the event that it reports was sent to the journal."""
    try:
        file.touch(0o600)
    except OSError as error:
        say(f"<4>cannot request a notice: {error}")

"""Requests a notice while the dataflow runs: a node is given up, or a machine is lost.

Before systemd 254 also at its end: the memory of a recorder is gone when the unit has failed.

The runner may start no unit. It writes a file into a directory that doranotice@NAME.path watches.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path

from dora_systemd.adapters.host import notify
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.given_up import given_up
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.logs.journal_events import GIVEN_UP
from dora_systemd.paths import LAST_REQUEST, request_file
from dora_systemd.runner.cell.failure import say

_HAND_OVER_SECONDS = 20.0
"""Less than WatchdogSec=. The service that opens the ring has the least share of the processor."""
_POLL_SECONDS = 0.05


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


def hand_over_ring(options: RunnerOptions, end: RunnerExit | None) -> None:
    """Wait until the service that writes bundles has opened the ring, if no other life follows."""
    if not options.is_noticed or options.of_dataflow("black_box") is None:
        return
    is_final = end in (RunnerExit.NODES_FAILED, RunnerExit.RESTARTS_SPENT)
    is_final |= restart_of(options).policy == "no" and end not in (None, RunnerExit.OK)
    if is_final and (file := request_file(os.environ)):
        notify.send_alive()
        await_removal(file.with_name(LAST_REQUEST), _HAND_OVER_SECONDS)


def await_removal(file: Path, seconds: float) -> None:
    """Request a notice by this file, and wait until it is removed."""
    request(file)
    deadline = time.monotonic() + seconds
    while file.exists() and time.monotonic() < deadline:
        time.sleep(_POLL_SECONDS)

"""Stop and Restart of dora's protocol: jobs of systemd, bounded by dora's grace duration."""

import asyncio
import signal
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.answers import stopped
from dora_systemd.decisions.gateway.frames import Request
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.session import Talk, find_by_uuid
from dora_systemd.gateway.control.state import ended_result
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.facts.locks import uninhibited
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.restart import require_startable, restart_cells
from dora_systemd.verbs.stop import find_dependents, note_stop, stop_cells

_FORCE_SECONDS = 0.2
"""Time for systemd to begin the stop: a kill before that would count as a failure."""


async def stop(talk: Talk, request: Request) -> dict[str, Any]:
    """Stop and StopByName. Raises DoraSystemdError."""
    scope, cell = talk.scope, await _find(talk, request)
    if not cell.is_up:
        raise DoraSystemdError(
            f"cannot stop {cell.name}: it does not run",
            f"doractl {scope.flag} why {cell.name} says how it ended",
            ExitCode.NOT_RUNNING,
        )
    await asyncio.to_thread(refuse_parts, [cell], "stop")
    await asyncio.to_thread(_note_stop, scope, cell)
    outcome = await _within(scope, cell, request, lambda: stop_cells(Bus(scope), scope, [cell])[0])
    if outcome.problem:
        raise DoraSystemdError(outcome.problem)
    if request.body.get("force"):
        return stopped(cell.uuid, 0, {})  # the stop was requested, so this counts as success
    return await asyncio.to_thread(ended_result, scope, cell.uuid)


async def restart(talk: Talk, request: Request) -> dict[str, Any]:
    """Restart and RestartByName. Raises DoraSystemdError."""
    scope, cell = talk.scope, await _find(talk, request)
    with ExitStack() as held:
        # Before the time of `_within` begins, which ends in a kill.
        await asyncio.to_thread(_hold, held, scope, cell)
        await asyncio.to_thread(refuse_parts, [cell], "restart")
        await asyncio.to_thread(require_startable, scope, cell)
        outcome = await _within(scope, cell, request, lambda: _restart(scope, cell))
    if outcome.problem:
        hint = outcome.hint or f"doractl {scope.flag} why {cell.name} shows more"
        raise DoraSystemdError(outcome.problem, hint)
    return {"DataflowRestarted": {"old_uuid": cell.uuid, "new_uuid": cell.uuid}}


def _note_stop(scope: Scope, cell: Cell) -> None:
    """Record in the journal who stops a dataflow and, with it, the dataflows that need it."""
    note_stop([cell], "dora stop")
    note_stop(find_dependents(Bus(scope), [cell]), f"dora stop {cell.name}")


def _restart(scope: Scope, cell: Cell) -> Outcome:
    (outcome,) = restart_cells(Bus(scope), scope, [cell], "dora restart", is_forced=True)
    return outcome


def _hold(held: ExitStack, scope: Scope, cell: Cell) -> None:
    """Take the lock of the dataflow into `held`. Raises DoraSystemdError as uninhibited()."""
    try:
        held.enter_context(uninhibited(scope, [cell], "restart"))
    except DoraSystemdError as error:
        if error.code is not ExitCode.INHIBITED:
            raise
        hint = f"doractl {scope.flag} restart --wait {cell.name} waits until it is free"
        raise DoraSystemdError(error.message, hint, error.code) from error


async def _find(talk: Talk, request: Request) -> Cell:
    if request.name.endswith("ByName"):
        return await asyncio.to_thread(
            lambda: Selector(request.text("name")).find(Bus(talk.scope, for_reading=True))
        )
    return await asyncio.to_thread(find_by_uuid, talk.scope, request.dataflow)


async def _within(
    scope: Scope, cell: Cell, request: Request, act: Callable[[], Outcome]
) -> Outcome:
    """Run `act`, and kill this run of the unit after the grace duration of the request."""
    task = asyncio.ensure_future(asyncio.to_thread(act))
    seconds = _patience(request)
    if seconds is not None and cell.is_up:
        life = await asyncio.to_thread(_life, scope, cell)
        await asyncio.wait([task], timeout=seconds)
        if not task.done() and await asyncio.to_thread(_life, scope, cell) == life:
            await asyncio.to_thread(_kill, scope, cell)
    return await task


def _patience(request: Request) -> float | None:
    if request.body.get("force"):
        return _FORCE_SECONDS
    grace = request.grace
    return None if grace is None else max(kill_delay(grace) / SECOND, _FORCE_SECONDS)


def _life(scope: Scope, cell: Cell) -> object:
    return Bus(scope, for_reading=True).read(cell.unit, ["InvocationID"])["InvocationID"]


def _kill(scope: Scope, cell: Cell) -> None:
    Bus(scope).kill(cell.unit, signal.SIGKILL)

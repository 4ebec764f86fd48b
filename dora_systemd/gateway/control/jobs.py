"""Start, Stop and Restart of dora's protocol: jobs of systemd.

A Start has a descriptor, a directory and the id of a session, but no file name. The dora command
1.1.0 keeps the id of a session in out/<stem>.dora-session.yaml, and writes that file before the
request. So the gateway finds the dataflow file without the descriptor that was sent.

Starting from a copy of the descriptor that was sent would lose the settings file, whose name is
derived from that of the dataflow file. Hot reload would watch a copy that nobody edits, and the
copy would not show who owns the dataflow.

A stop and a restart are bounded by dora's grace duration.
"""

import asyncio
import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import session_path
from dora_systemd.decisions.gateway.answers import stopped
from dora_systemd.decisions.gateway.frames import Request, sent_flags
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.gateway.control.session import Result, Talk, find_by_uuid
from dora_systemd.gateway.control.state import ended_result, spawned
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import SECOND, as_mapping, shown
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.facts.locks import uninhibited
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.restart import require_startable, restart_cells
from dora_systemd.verbs.start.read import written_dataflow
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.start import claim
from dora_systemd.verbs.start.start_unit import start_unit
from dora_systemd.verbs.stop import find_dependents, note_stop, stop_cells

_SUFFIXES = (".yml", ".yaml")
_MOST_FILES = 200
_MOST_NAMES = 20_000
_POLL_SECONDS = 0.1


async def start(talk: Talk, request: Request) -> dict[str, Any]:
    """Start: replies once systemd has queued the job. Raises DoraSystemdError."""
    began = time.time_ns() // 1000
    uuid = await asyncio.to_thread(_start, talk.scope, request)
    talk.started[uuid] = began
    return {"DataflowStartTriggered": {"uuid": uuid}}


async def wait_for_spawn(talk: Talk, request: Request) -> Result:
    """WaitForSpawn: replies once all nodes are ready. Raises DoraSystemdError."""
    while (answer := await asyncio.to_thread(spawned, talk.scope, request.dataflow)) is None:
        if talk.is_over:
            return None
        await asyncio.sleep(_POLL_SECONDS)
    return answer


def _start(scope: Scope, request: Request) -> str:
    wanted = wanted_start(request)
    bus = Bus(scope)
    claimed = claim(bus, scope, wanted, "dora start")
    options, links = claimed.plan.options, claimed.links
    return start_unit(bus, scope, options, claimed.properties, None, False, links).uuid


def wanted_start(request: Request) -> StartRequest:
    """Return the StartRequest for a Start of dora's protocol. Raises DoraSystemdError."""
    if request.body.get("write_events_to") is not None:
        hint = "unset DORA_WRITE_EVENTS_TO, or use dora run"
        raise DoraSystemdError("cannot write the events of a supervised dataflow", hint)
    if not isinstance(request.body.get("dataflow"), dict):
        raise bad_input("cannot start: no dataflow was sent")
    name = request.body.get("name")
    path = find_file(Path(request.text("local_working_dir")), request.text("session_id"))
    flags = sent_flags(request, written_dataflow(str(path)).raw)
    return StartRequest(str(path), name if isinstance(name, str) else None, flags, os.environ)


def find_file(directory: Path, session: str) -> Path:
    """Find the only file in `directory` with this session, else raise DoraSystemdError."""
    found = [path for path in _files(directory) if _session(path) == session]
    if len(found) == 1:
        return found[0]
    names = ", ".join(path.name for path in found)
    raise _no_file(
        "cannot find out which file this dataflow is from: "
        + (f"{names} have one session" if found else f"no file in {directory} has its session")
    )


def _files(directory: Path) -> list[Path]:
    if not directory.is_absolute():
        raise DoraSystemdError(f"cannot start in {directory}: it is not an absolute path")
    try:
        names = list_directory(directory, _MOST_NAMES)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not a path"
        raise _no_file(
            f"cannot search for the dataflow in {shown(str(directory))}: {reason}"
        ) from error
    return [directory / name for name in names if name.endswith(_SUFFIXES)][:_MOST_FILES]


def _no_file(message: str) -> DoraSystemdError:
    return bad_input(message, "doractl start FILE takes the file itself")


def _session(path: Path) -> object:
    """The session id that the dora command sends for this file."""
    kept = Path(session_path(str(path)))
    with suppress(DoraSystemdError):
        document = parse_yaml(decoded(read_file(kept).data, kept), kept)
        return as_mapping(document).get("session_id")
    return None


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
        await asyncio.to_thread(_require_startable, scope, cell)
        outcome = await _within(scope, cell, request, lambda: _restart(scope, cell))
    if outcome.problem:
        hint = outcome.hint or f"doractl {scope.flag} why {cell.name} shows more"
        raise DoraSystemdError(outcome.problem, hint)
    return {"DataflowRestarted": {"old_uuid": cell.uuid, "new_uuid": cell.uuid}}


def _require_startable(scope: Scope, cell: Cell) -> None:
    require_startable(Bus(scope), scope, cell)


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

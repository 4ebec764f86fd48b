"""Start of dora's protocol: finds the file of the descriptor, and starts it as doractl does.

A request has a descriptor, a directory and the id of a session, but no file name. The dora command
1.1.0 keeps the id of a session in out/<stem>.dora-session.yaml, and writes that file before the
request. So the gateway finds the dataflow file without the descriptor that was sent.

Starting from a copy of the descriptor that was sent would lose the settings file, whose name is
derived from that of the dataflow file. Hot reload would watch a copy that nobody edits, and the
copy would not show who owns the dataflow.
"""

import asyncio
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import session_path
from dora_systemd.decisions.gateway.frames import Request, sent_flags
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.session import Result, Talk
from dora_systemd.gateway.control.state import spawned
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import as_mapping, shown
from dora_systemd.verbs.facts.nodes import written_dataflow
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.start import claim
from dora_systemd.verbs.start.start_unit import start_unit

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
        raise DoraSystemdError("cannot start: no dataflow was sent", "", ExitCode.BAD_INPUT)
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
    return DoraSystemdError(message, "doractl start FILE takes the file itself", ExitCode.BAD_INPUT)


def _session(path: Path) -> object:
    """The session id that the dora command sends for this file."""
    kept = Path(session_path(str(path)))
    with suppress(DoraSystemdError):
        document = parse_yaml(decoded(read_file(kept).data, kept), kept)
        return as_mapping(document).get("session_id")
    return None

"""Start of dora's protocol: finds the file of the descriptor, and starts it as doractl does."""

import asyncio
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.build_session import session_path
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.decisions.gateway.frames import Request
from dora_systemd.decisions.gateway.match import could_be, sent_flags
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.state import spawned
from dora_systemd.gateway.control.talk import Result, Talk
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import shown
from dora_systemd.verbs.start.check import run_beside
from dora_systemd.verbs.start.job import start_plan
from dora_systemd.verbs.start.launch import claim
from dora_systemd.verbs.start.plan import StartRequest, make_plan

_SUFFIXES = (".yml", ".yaml")
_MOST_FILES = 200
_MOST_NAMES = 20_000
_POLL_SECONDS = 0.1


@dataclass(frozen=True)
class Match:
    """A file that yields the descriptor that was sent, if it is started with these flags."""

    path: Path
    flags: Mapping[str, object]


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
    if request.body.get("write_events_to") is not None:
        hint = "unset DORA_WRITE_EVENTS_TO, or use dora run"
        raise DoraSystemdError("cannot write the events of a supervised dataflow", hint)
    name = request.body.get("name")
    found = find_file(scope, request)
    wanted = StartRequest(
        str(found.path), name if isinstance(name, str) else None, found.flags, os.environ
    )
    bus = Bus(scope)
    claimed = claim(bus, scope, wanted)
    return start_plan(bus, claimed.plan, claimed.properties, None, wait=False).uuid


def find_file(scope: Scope, request: Request) -> Match:
    """The one matching file. Raises DoraSystemdError if there is none, or several."""
    directory, sent = Path(request.text("local_working_dir")), request.body.get("dataflow")
    if not isinstance(sent, dict):
        raise DoraSystemdError("cannot start: no dataflow was sent", "", ExitCode.BAD_INPUT)
    files = [path for path in _files(directory) if could_be(_read(path), sent)]
    found = [one for one in (_match(scope, path, request, sent) for path in files) if one]
    if len(found) > 1:
        session = request.body.get("session_id")
        found = [one for one in found if _session(one.path) == session] or found
    if len(found) == 1:
        return found[0]
    names = ", ".join(one.path.name for one in found)
    reason = f"{names} fit it equally" if found else f"no file in {directory} holds it"
    raise DoraSystemdError(
        f"cannot tell which file this dataflow is from: {reason}",
        "doractl start FILE takes the file itself",
        ExitCode.BAD_INPUT,
    )


def _files(directory: Path) -> list[Path]:
    if not directory.is_absolute():
        raise DoraSystemdError(f"cannot start in {directory}: it is not an absolute path")
    try:
        names = list_directory(directory, _MOST_NAMES)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not a path"
        raise DoraSystemdError(
            f"cannot look for the dataflow in {shown(str(directory))}: {reason}",
            "doractl start FILE takes the file itself",
            ExitCode.BAD_INPUT,
        ) from error
    return [directory / name for name in names if name.endswith(_SUFFIXES)][:_MOST_FILES]


def _read(path: Path) -> object:
    with suppress(DoraSystemdError):
        return parse_yaml(_text(path), path)
    return None


def _text(path: Path) -> str:
    return decoded(read_file(path).data, path)


def _match(scope: Scope, path: Path, request: Request, sent: Mapping[str, Any]) -> Match | None:
    # Only dora can expand the file: run the user's dora, in a unit like that of the dataflow.
    plan = make_plan(scope, StartRequest(str(path), None, {}, os.environ))
    done = run_beside(lambda: Bus(scope), plan, [plan.options.dora, "expand", str(path)])
    if done.status:
        reason = parse_dora_error(done.stderr)
        raise DoraSystemdError(f"cannot expand {path}: {reason}", "", ExitCode.BAD_INPUT)
    expanded = parse_yaml(done.stdout, path)
    if not isinstance(expanded, dict):
        return None
    has_variables = "$" in _text(path)
    flags = sent_flags(sent, expanded, bool(request.body.get("uv")), has_variables)
    return None if flags is None else Match(path, flags)


def _session(path: Path) -> object:
    """The session id that the dora command sends for this file."""
    document = _read(Path(session_path(str(path))))
    return document.get("session_id") if isinstance(document, dict) else None

"""The runner's own socket in the RuntimeDirectory: one request, one answer, both a line of JSON.

Nobody but root and the user of the dataflow gets into that directory: see unix(7).
"""

import asyncio
import contextlib
import json
import os
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode

Request = Mapping[str, Any]
Answer = Callable[[Request], Awaitable[dict[str, Any]]]

MAX_BYTES = 1 << 16
ANSWER_SECONDS = 150.0
"""A reload may have to wait for a grace duration, and for nodes to be ready."""


async def serve(path: Path, answer: Answer) -> None:
    """Answer requests at `path` for ever. An error is {"error": ..., "hint": ..., "code": ...}."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, ValueError):
            reply = await _answer(await reader.readline(), answer)
            writer.write(json.dumps(reply).encode() + b"\n")
            await writer.drain()
        writer.close()

    path.unlink(missing_ok=True)
    with _short(path) as address, socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        path.chmod(0o600)
        server = await asyncio.start_unix_server(talk, sock=listener, limit=MAX_BYTES)
        async with server:
            await server.serve_forever()


@contextlib.contextmanager
def _short(path: Path) -> Iterator[str]:
    """The address of a socket has 107 bytes, see unix(7); a dataflow's name may have 200."""
    directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{directory}/{path.name}"
    finally:
        os.close(directory)


async def _answer(line: bytes, answer: Answer) -> dict[str, Any]:
    try:
        request = json.loads(line)
        return await answer(request if isinstance(request, dict) else {})
    except ValueError:
        return _refusal(DoraSystemdError("cannot read the request", "", ExitCode.USAGE))
    except DoraSystemdError as error:
        return _refusal(error)
    except Exception as error:
        # A request that we do not understand ends nothing but itself.
        what = f"cannot do that: {type(error).__name__}: {error}"
        return _refusal(DoraSystemdError(what, "please report it"))


def _refusal(error: DoraSystemdError) -> dict[str, Any]:
    return {"error": error.message, "hint": error.hint, "code": int(error.code)}


def ask(path: Path, request: Request, seconds: float = ANSWER_SECONDS) -> dict[str, Any]:
    """The answer of the runner at `path`. Raises DoraSystemdError, what it refuses included."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stream:
            stream.settimeout(seconds)
            with _short(path) as address:
                stream.connect(address)
            stream.sendall(json.dumps(request).encode() + b"\n")
            reply = json.loads(stream.makefile().readline())
    except PermissionError as error:
        hint = "use sudo: only root and the user it runs as may"
        raise _unreachable(path, "permission denied", hint, ExitCode.NO_PERMISSION) from error
    except (OSError, ValueError) as error:
        hint = "it may be starting or stopping; see doractl list"
        raise _unreachable(path, str(error), hint, ExitCode.NOT_RUNNING) from error
    if "error" in reply:
        raise DoraSystemdError(reply["error"], reply["hint"], ExitCode(reply["code"]))
    return dict(reply)


def _unreachable(path: Path, reason: str, hint: str, code: ExitCode) -> DoraSystemdError:
    name = path.parent.name
    return DoraSystemdError(f"cannot reach the runner of {name}: {reason}", hint, code)

"""Requests to the runner over its socket: one request, one answer, each a line of JSON.

listener.py is the other side. Only root and the user of the dataflow can access the directory of
the socket, see unix(7). root must not trust that user, who can put anything there. So trust.sockets
checks the owner, an answer has a timeout, a maximum size and a schema, and its texts are shown
without control characters.

The answer to {"verb": "relay"} has the coordinator's token. After that the connection passes bytes
to and from the coordinator: of the right dataflow, whatever network the dataflow has, and whatever
else listens on ports of this machine.
"""

import contextlib
import json
import socket
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dora_systemd import __version__
from dora_systemd.decisions.dora.protocol import Coordinator, parse_coordinator, parse_token
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.trust.sockets import connect_unix, plain
from dora_systemd.values import as_mapping, quoted

Request = Mapping[str, Any]
MAX_BYTES = 1 << 16
ANSWER_SECONDS = 150.0
"""A reload may have to wait for a grace duration, and for nodes to be ready; its caller knows how
long nodes may take to stop."""
RELAY_SECONDS = 4.0


def ask(path: Path, request: Request, seconds: float = ANSWER_SECONDS) -> dict[str, Any]:
    """The answer of the runner at `path`. Raises DoraSystemdError, also for a refusal."""
    with _reaching(path), connect_unix(path, seconds) as stream:
        return _exchange(stream, path, request, seconds)


def order(
    path: Path, request: Request, seconds: float = RELAY_SECONDS, most: float = ANSWER_SECONDS
) -> dict[str, Any]:
    """Send a request that may take `most` seconds, to a runner that responds now.

    A runner that is stopped, or does not answer on purpose, fails after `seconds`. Raises
    DoraSystemdError.
    """
    # A refusal counts as a response: a reload does not need a coordinator.
    refused = contextlib.suppress(DoraSystemdError)
    with _reaching(path), connect_unix(path, seconds) as stream, refused:
        _exchange(stream, path, {"verb": "coordinator"}, seconds)
    return ask(path, request, most)


def ask_refusal(path: Path) -> DoraSystemdError | None:
    """Return the error with which the runner at `path` could not start its dataflow, or None.

    Raises DoraSystemdError if the runner does not answer.
    """
    reply = order(path, {"verb": "check"})
    refused = reply.get("refused")
    if refused is not None and not isinstance(refused, dict):
        raise _unreadable(path)
    return _error(path, refused) if refused else None


def refused_reply(error: DoraSystemdError | None) -> dict[str, Any]:
    """The answer that ask_refusal() reads."""
    return {"refused": error_reply(error) if error else None}


def unknown_request(request: Request) -> DoraSystemdError:
    """The error for a request that this runner does not know: another doractl has sent it."""
    told = f"cannot do {quoted(str(request))}: the runner is of dora-systemd {__version__}"
    return usage_error(told, "doractl restart NAME starts the installed version")


def error_reply(error: DoraSystemdError) -> dict[str, Any]:
    """An error, in an answer."""
    return {"error": error.message, "hint": error.hint, "code": int(error.code)}


def ask_coordinator(path: Path) -> Coordinator:
    """The address of the coordinator of the runner at `path`. Raises DoraSystemdError."""
    reply = ask(path, {"verb": "coordinator"}, RELAY_SECONDS)
    with _reaching(path):
        return parse_coordinator(reply)


def relay(path: Path) -> tuple[socket.socket, str]:
    """A connection to the coordinator of the runner at `path`, and the coordinator's token.

    It is blocking, without a timeout. Raises DoraSystemdError.
    """
    with _reaching(path), contextlib.ExitStack() as undo:
        stream = undo.enter_context(connect_unix(path, RELAY_SECONDS))
        reply = _exchange(stream, path, {"verb": "relay"}, RELAY_SECONDS)
        token = parse_token(reply.get("token"))
        stream.settimeout(None)
        undo.pop_all()
        return stream, token


def done_of(path: Path, reply: Request) -> list[str]:
    """Return the human-readable results that the runner at `path` reports.

    Raises DoraSystemdError.
    """
    done = reply.get("done")
    if not isinstance(done, list) or not all(isinstance(one, str) for one in done):
        raise _unreadable(path)
    return [plain(one) for one in done]


def parse_line(line: bytes) -> dict[str, Any] | None:
    """A request or an answer; None if it is not JSON, and empty if it is not an object."""
    try:
        request = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return as_mapping(request)


def _exchange(
    stream: socket.socket, path: Path, request: Request, seconds: float
) -> dict[str, Any]:
    deadline = time.monotonic() + seconds
    stream.sendall(json.dumps(request).encode() + b"\n")
    reply = parse_line(_read_line(stream, deadline))
    if not reply:
        raise _unreadable(path)
    if "error" in reply:
        raise _error(path, reply)
    return reply


def _error(path: Path, reply: Request) -> DoraSystemdError:
    """The error in an answer of the runner at `path`."""
    message, hint = (reply.get(key) for key in ("error", "hint"))
    words = _words(message) or f"the runner of {path.parent.name} refuses that"
    return DoraSystemdError(words, _words(hint), _code(reply.get("code")))


def _read_line(stream: socket.socket, deadline: float) -> bytes:
    """Read one line before `deadline`. Raises OSError, ValueError for a line without an end."""
    line = b""
    while not line.endswith(b"\n"):
        stream.settimeout(max(deadline - time.monotonic(), 0.001))
        data = stream.recv(MAX_BYTES)
        line += data
        if not data or len(line) > MAX_BYTES:
            raise ValueError("it does not answer")
    return line


def _words(found: object) -> str:
    return plain(found) if isinstance(found, str) else ""


def _code(found: object) -> ExitCode:
    known = {int(code): code for code in ExitCode if code}
    return known.get(found, ExitCode.FAILURE) if type(found) is int else ExitCode.FAILURE


@contextlib.contextmanager
def _reaching(path: Path) -> Iterator[None]:
    try:
        yield
    except PermissionError as error:
        hint = "use sudo: only root and the user it runs as may"
        raise _unreachable(path, "permission denied", hint, ExitCode.NO_PERMISSION) from error
    except (OSError, ValueError) as error:
        hint = "it may be starting, stopping or frozen; see doractl list"
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise _unreachable(path, reason, hint, ExitCode.NOT_RUNNING) from error


def _unreadable(path: Path) -> DoraSystemdError:
    reason = "it answers something else than was asked"
    hint = "restart the dataflow; it may be of another version"
    return _unreachable(path, reason, hint, ExitCode.FAILURE)


def _unreachable(path: Path, reason: str, hint: str, code: ExitCode) -> DoraSystemdError:
    name = path.parent.name
    return DoraSystemdError(f"cannot reach the runner of {name}: {reason}", hint, code)

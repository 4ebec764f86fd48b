"""The first words between a link and the runner of the head."""

import json
import socket
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.machines.wire import MAX_LINE, Forwards, expect, parse_message
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.sockets import connect_unix

_SECONDS = 10.0
"""For each answer: the runner knows its ports soon."""
_CHUNK = 1 << 16


class Greeted(NamedTuple):
    """A session with a runner. rest: what it has said after its ports."""

    runner: socket.socket
    forwards: Forwards
    rest: bytes


def greeted(path: Path, machine: str) -> Greeted | None:
    """A session for the link to `machine`; None if no runner is at `path` that has one now.

    Raises DoraSystemdError (NO_PERMISSION) if the socket is another user's.
    """
    with ExitStack() as undo:
        try:
            runner = undo.enter_context(connect_unix(path, _SECONDS))
            runner.sendall(json.dumps({"verb": "link", "machine": machine}).encode() + b"\n")
            line, rest = _first_line(runner)
            forwards = expect(parse_message(line), Forwards)
        except OSError:
            return None
        except DoraSystemdError as error:
            if error.code is ExitCode.NO_PERMISSION:
                raise
            return None
        runner.settimeout(None)
        undo.pop_all()
        return Greeted(runner, forwards, rest)


def _first_line(runner: socket.socket) -> tuple[bytes, bytes]:
    data = b""
    while b"\n" not in data and len(data) < MAX_LINE:
        more = runner.recv(_CHUNK)
        if not more:
            raise ConnectionError
        data += more
    line, _, rest = data.partition(b"\n")
    return line, rest

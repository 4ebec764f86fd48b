"""The main process of a link, which passes lines between the runner of the head and a member.

A link ends with its ssh(1), and systemd starts the link again: each connection begins with the
ports and the Part that the runner sends then. An unreachable machine is no failure of the link.
"""

import json
import os
import socket
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.machines.link_command import (
    LinkOptions,
    parse_link_argv,
    ssh_link_arguments,
)
from dora_systemd.decisions.machines.wire import MAX_LINE, Forwards, Refused, expect, parse_message
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.link.talk import Program, Talk, tell
from dora_systemd.trust.paths import exists
from dora_systemd.trust.sockets import connect_unix

_ANSWER_SECONDS = 10.0
"""Time for an answer of the runner, which knows its ports soon."""
_CHUNK = 1 << 16
_PAUSE_SECONDS = 1.0
_FIRST_SECONDS, _LATER_SECONDS = 0.01, 0.25
_QUICK_TRIES = 500


class Greeted(NamedTuple):
    """A session with a runner."""

    runner: socket.socket
    forwards: Forwards
    rest: bytes  # what the runner has sent after its ports


def greeted(path: Path, machine: str) -> Greeted | None:
    """Open a session for the link to `machine`; None if no runner at `path` accepts a session now.

    Raises DoraSystemdError (NO_PERMISSION) if the socket is another user's.
    """
    with ExitStack() as undo:
        try:
            runner = undo.enter_context(connect_unix(path, _ANSWER_SECONDS))
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


class Watchdog:
    """Sends WATCHDOG=1 at most once a second; does nothing without NOTIFY_SOCKET.

    To the head, a link that hangs looks like an unreachable machine; only systemd can end the link.
    """

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._last = float("-inf")

    def feed(self) -> None:
        """Send the message, if one is due."""
        now = time.monotonic()
        if self._address and now - self._last >= _PAUSE_SECONDS:
            self._last = now
            kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
            with suppress(OSError), socket.socket(socket.AF_UNIX, kind) as one:
                one.sendto(b"WATCHDOG=1", self._address)


def main() -> int:
    """Pass lines until ssh or the runner has ended; return the exit status."""
    try:
        link = parse_link_argv(sys.argv[1:])
        return _carry(link)
    except DoraSystemdError as error:
        print(f"{error.message}; hint: {error.hint}", file=sys.stderr)
        return error.code


def _carry(link: LinkOptions) -> int:
    tries, watchdog = 0, Watchdog()
    while (found := greeted(Path(link.socket), link.machine)) is None:
        watchdog.feed()
        # The runner starts, or waits for its restart: otherwise systemd stops this unit.
        time.sleep(_FIRST_SECONDS if tries < _QUICK_TRIES else _LATER_SECONDS)
        tries += 1
    with found.runner:
        try:
            _connect(link, found, watchdog)
        except DoraSystemdError as error:
            tell(found.runner, Refused(error.message, error.hint))
    return ExitCode.OK


def _connect(link: LinkOptions, found: Greeted, watchdog: Watchdog) -> None:
    """Run ssh until ssh or the runner has ended. Raises DoraSystemdError if ssh cannot log in."""
    if link.identity and not exists(Path(link.identity)):
        # ssh would report no error, and log in with another key.
        message = f"cannot log in: the key {link.identity} is gone"
        hint = f"doractl machine remove --force {link.machine}, then doractl machine add"
        raise DoraSystemdError(message, hint, ExitCode.NO_HOST)
    mark = f"doralink-{os.urandom(16).hex()}"
    arguments = ssh_link_arguments(link, found.forwards, mark)
    try:
        ssh = Program("ssh", arguments)
    except OSError as error:
        message = f"cannot execute ssh: {error.strerror}"
        raise DoraSystemdError(message, "apt install openssh-client", ExitCode.NO_HOST) from error
    with ssh:
        talk = Talk(found.runner, ssh, mark, found.rest, watchdog.feed)
        talk.carry()
        talk.part_from(link.host, ssh.end())


if __name__ == "__main__":
    sys.exit(main())

"""What a member does before it imports the rest of the runner: its daemon joins the head meanwhile.

`doractl member` has made a connection for its relay, and has said in it what to run. Its end for
the runner comes by standard input. It is not standard input itself: systemd keeps a copy of that
as long as the unit has any process, and the head has to know at once that this one has ended.
Imports only what loads quickly.
"""

import os
import socket
import struct
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.own import own_options
from dora_systemd.decisions.machines.wire import MAX_LINE, Part, expect, parse_message
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, start_daemon
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.machines.zenoh import member_arguments, shared_environment

_FD = struct.Struct("i")


class MemberBoot(EarlyDaemon):
    """The daemon of a member. part: what its head has said. rest: what it has said since.

    Raises OSError, and DoraSystemdError (USAGE) if there is no head.
    """

    def __init__(
        self, options: RunnerOptions, paths: CellPaths, unit: Path, environment: Mapping[str, str]
    ) -> None:
        self.connection = received()
        with ExitStack() as undo:
            undo.callback(self.connection.close)
            line, _, self.rest = _said(self.connection).partition(b"\n")
            self.part = expect(parse_message(line), Part)
            if (self.part.name, self.part.machine) != (options.name, options.machine):
                raise no_head()
            undo.pop_all()
        self._addresses = options.addresses
        own = shared_environment(environment, options.addresses)
        super().__init__(own_options(options), paths, unit, own)

    def _find_port(self) -> int:
        return self.part.coordinator

    def _spawn_daemon(self) -> Daemon:
        more = member_arguments(self.part, self._environment, self._addresses)
        given = (self._dora, self._paths, self._port, self._environment)
        return start_daemon(*given, self.part.token, more)


def _said(connection: socket.socket) -> bytes:
    """What the head has said before this process began; b"" if nothing."""
    with suppress(BlockingIOError):
        return connection.recv(MAX_LINE, socket.MSG_DONTWAIT)
    return b""


def received() -> socket.socket:
    """The connection that waits in standard input, which is /dev/null from then on.

    Raises DoraSystemdError (USAGE) if there is none.
    """
    with socket.socket(fileno=os.dup(0)) as stdin:
        nothing = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
        os.dup2(nothing, 0)
        os.close(nothing)
        # Not socket.recv_fds(), which leaves out these flags.
        flags = socket.MSG_DONTWAIT | socket.MSG_CMSG_CLOEXEC
        _, given, _, _ = stdin.recvmsg(1, socket.CMSG_SPACE(_FD.size), flags)
    fds = [_FD.unpack(data)[0] for _, kind, data in given if kind == socket.SCM_RIGHTS]
    if len(fds) != 1:
        raise no_head()
    return socket.socket(fileno=fds[0])


def no_head() -> DoraSystemdError:
    """The error of a member that nobody has told what to run."""
    hint = "doractl start on the head starts the members"
    return DoraSystemdError("cannot run a member: no head says what to run", hint, ExitCode.USAGE)

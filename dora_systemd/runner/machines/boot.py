"""What head and member do before they import the rest of the runner, and the ports for it.

The links of a head wait for its ports, and the daemon of a member joins the head meanwhile.

`doractl member` has created a pair of sockets, one for its relay and one for the runner, and has
sent the Part through the pair. The socket of the runner arrives as a message on standard input.
Standard input itself would not do: systemd keeps a copy as long as the unit has any process, and
the head must notice at once that the runner has ended. This module imports only what loads quickly.
addresses below: of the options; the daemon of a machine listens on the first address.
"""

import json
import os
import socket
import struct
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from errno import EADDRINUSE
from pathlib import Path

from dora_systemd.adapters.host.addresses import listen_error, port_error
from dora_systemd.adapters.runner_socket.door import Door
from dora_systemd.decisions.cell.machines import HEAD, members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.address import LOOPBACK, endpoint
from dora_systemd.decisions.machines.part import own_options
from dora_systemd.decisions.machines.wire import (
    MAX_LINE,
    PORT_RANGE,
    Forwards,
    Part,
    expect,
    format_message,
    parse_message,
)
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import start_coordinator
from dora_systemd.runner.cell.boot import Boot, EarlyDaemon

GREETED = "greeted"
"""A key of a request for a session that has got its ports already."""
_FD = struct.Struct("i")
_ZENOH = Path(__file__).parents[2] / "zenoh-machines.json5"
_NO_DIRECT = {"DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS": "0"}
"""Where ssh carries the messages, nodes of different machines do not connect to each other: the
addresses would be those of 127.0.0.1. So dora must not wait 1.5 s for such connections."""
_OVERLAYS = ("ZENOH_CONFIG", "DORA_ZENOH_CONFIG_OVERLAY")
"""Variables with which a user configures zenoh: dora refuses them next to an overlay of ours."""


def choose_ports(
    members: Sequence[str], addresses: Sequence[str] = (), ports: Sequence[int] = PORT_RANGE
) -> Forwards:
    """Choose free ports, other ones each time. Raises DoraSystemdError if there are none.

    addresses: of the options; the daemon here listens on the first one.
    """
    begin = int.from_bytes(os.urandom(4)) % len(ports)
    turned = (*ports[begin:], *ports[:begin])
    own = addresses[:1]
    free = (
        port
        for port in turned
        if not port_error(port) and not any(listen_error(one, port) == EADDRINUSE for one in own)
    )
    try:
        return Forwards(next(free), {one: next(free) for one in (HEAD, *members)})
    except StopIteration:
        message = f"cannot find free ports from {ports[0]} to {ports[-1]}"
        raise DoraSystemdError(message, "see: ss -ltn") from None


def shared_environment(environment: Mapping[str, str], addresses: Sequence[str]) -> dict[str, str]:
    """Return the environment of dora's processes."""
    return {**environment, **({} if addresses else _NO_DIRECT)}


def head_arguments(
    ports: Forwards, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    """Return the arguments by which the daemon of the head connects to those of members."""
    return _arguments(ports.zenoh[HEAD], environment, addresses)


def member_arguments(
    part: Part, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    """Return the arguments of the daemon of a member, with the machine's name."""
    return ("--machine-id", part.machine, *_arguments(part.zenoh, environment, addresses))


def _arguments(
    port: int, environment: Mapping[str, str], addresses: Sequence[str]
) -> tuple[str, ...]:
    has_own = any(name in environment for name in _OVERLAYS)
    overlay = () if has_own else ("--zenoh-config-overlay", str(_ZENOH))
    return ("--zenoh-listen", endpoint([*addresses, LOOPBACK][0], port), *overlay)


class HeadBoot(Boot):
    """The dora of a head, on ports that all machines know. door: sends the ports to the links."""

    def __init__(
        self, options: RunnerOptions, paths: CellPaths, unit: Path, environment: Mapping[str, str]
    ) -> None:
        members = members_of(options.placed)
        self.ports = choose_ports(members, options.addresses)
        told = forwards(options, self.ports)
        self.door = Door(paths.socket, lambda line: greeting(line, members, told))
        own = shared_environment(environment, options.addresses)
        try:
            coordinator = start_coordinator(options.dora, paths, own, self.ports.coordinator)
        except (OSError, DoraSystemdError):
            self.door.close()
            raise
        more = head_arguments(self.ports, own, options.addresses)
        super().__init__(coordinator, options, paths, unit, own, more)


def forwards(options: RunnerOptions, ports: Forwards) -> Forwards:
    """Return the ports for a link. With direct connections, ssh does not forward zenoh's ports."""
    return replace(ports, zenoh={}) if options.addresses else ports


def greeting(line: bytes, members: tuple[str, ...], ports: Forwards) -> tuple[bytes, bytes]:
    """Return the ports for a link, and its request marked as greeted; see Greet."""
    try:
        request = json.loads(line)
        is_link = request.get("verb") == "link" and request.get("machine") in members
    except (ValueError, AttributeError, TypeError, RecursionError):
        is_link = False
    if not is_link:
        return b"", line
    return format_message(ports), json.dumps({**request, GREETED: True}).encode()


class MemberBoot(EarlyDaemon):
    """The daemon of a member. part: the Part from the head. rest: received after the Part.

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
        own = shared_environment(environment, options.addresses)
        more = member_arguments(self.part, own, options.addresses)
        super().__init__(own_options(options), paths, unit, own, self.part.token, more)

    def _find_port(self) -> int:
        return self.part.coordinator


def _said(connection: socket.socket) -> bytes:
    """Receive what the head sent before this process began; b"" for nothing."""
    with suppress(BlockingIOError):
        return connection.recv(MAX_LINE, socket.MSG_DONTWAIT)
    return b""


def received() -> socket.socket:
    """Receive the connection that waits in standard input, and replace stdin by /dev/null.

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
    """Return the error of a member that has received no Part."""
    hint = "doractl start on the head starts the members"
    return usage_error("cannot run a member: no head says what to run", hint)

"""`doractl member`: the part of a dataflow on this machine, for a head that logs in by ssh.

The command line determines what runs on this machine, and only the doractl of the head writes that
line. The head's runner, whose memory the nodes on the head can change, only sends where the
coordinator is. The answer is a Refused if a new attempt cannot help, and else an exit status.
"""

import hashlib
import os
import select
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import NoReturn, Protocol

from dora_systemd import __version__
from dora_systemd.adapters.bus.manager import Manager, is_at_rest
from dora_systemd.adapters.dora.command import version_numbers
from dora_systemd.adapters.host.addresses import is_own
from dora_systemd.decisions.machines.link_command import relay_command
from dora_systemd.decisions.machines.part import COPY_HINT, format_other_file
from dora_systemd.decisions.machines.wire import (
    BEAT_SECONDS,
    LEASE_SECONDS,
    MAX_LINE,
    Beat,
    Message,
    Part,
    expect,
    format_message,
    parse_message,
)
from dora_systemd.decisions.unit.systemd_versions import transient_commands
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.sockets import is_open_beyond, plain
from dora_systemd.values import INFINITY
from dora_systemd.verbs.facts.cells import read_cell
from dora_systemd.verbs.facts.reason import failure_reason, runners_refusal
from dora_systemd.verbs.start.enable import drop_unit_files
from dora_systemd.verbs.start.logins import is_lingering, linger_command
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.start import make_room, refuse_unit_file, require_free_name
from dora_systemd.verbs.start.unit import plan_properties, systemd_number

_START_SECONDS = 60.0
"""Timeout of the first line of the runner."""
_LOOK_SECONDS = 0.1
_PASSING = (ExitCode.FAILURE, ExitCode.NO_SYSTEMD)
"""Errors that the next attempt may not meet, such as a machine that still boots."""


@dataclass(frozen=True)
class MemberRequest:
    """The command line."""

    scope: Scope
    start: StartRequest  # what to run, with name, UUID, nodes and the name of this machine
    address_seconds: float = 10.0  # until this machine must have its address
    # for a part of a former start to end; an attempt later may find it gone
    end_seconds: float = 60.0

    @property
    def unit(self) -> str:
        return unit_name(self.start.name or "")


def is_passing(error: DoraSystemdError) -> bool:
    """Whether a new attempt may help."""
    return error.code in _PASSING


class Teller(Protocol):
    """The methods of Head that a start needs."""

    def part(self) -> Part:
        """Receive the Part. Raises DoraSystemdError."""

    def say(self, line: bytes) -> None:
        """Send a whole line."""


def start_member(manager: Manager, request: MemberRequest, head: Teller) -> socket.socket:
    """Start the part that the head describes; return the connection to its runner.

    The part ends with that connection. The first line of the runner has been passed on. Raises
    DoraSystemdError; then nothing runs.
    """
    part = head.part()
    _check_part(part, request.start)
    _check_forwards(part)
    _check_linger(request.scope)
    _wait_for_address(request, is_passing=bool(part.again))
    _end_old_part(manager, request)
    boot = require_free_name(manager, request.scope, request.unit)
    refuse_unit_file(boot)
    plan = _member_plan(make_plan(request.scope, request.start), part)
    _check_same(part, plan)
    properties, _ = plan_properties(plan, manager)
    make_room(manager, boot)
    drop_unit_files(manager, boot)
    told = transient_commands(list(properties.values()), systemd_number(manager))
    runner, stdin = _connected(part)
    with stdin:
        handed = ("StandardInputFileDescriptor", "h", stdin.fileno())
        _start_transient(manager, request.unit, [*told, handed])
    try:
        head.say(_first_answer(manager, request.unit, runner))
    except BaseException:
        runner.close()
        with suppress(DoraSystemdError):
            manager.run_jobs("StopUnit", [request.unit])
        raise
    return runner


def become_relay(runner: socket.socket) -> NoReturn:
    """Replace this process by a small one that passes lines as long as the part lives."""
    runner.setblocking(True)
    runner.set_inheritable(True)
    os.execv(sys.executable, relay_command(sys.executable, runner.fileno(), LEASE_SECONDS))


def _check_part(part: Part, start: StartRequest) -> None:
    """Raise DoraSystemdError unless the head's doractl and its runner name the same dataflow."""
    if (part.name, part.uuid, part.machine) != (start.name, start.uuid, start.machine):
        raise bad_input("the head's runner wants to run another dataflow than its doractl")


def _check_forwards(part: Part) -> None:
    """Raise DoraSystemdError if GatewayPorts of sshd_config(5) opens the ports to the network."""
    if is_open_beyond(part.coordinator):
        hint = "on that machine, in sshd_config: GatewayPorts no"
        raise bad_input("sshd there opens forwarded ports to the whole network", hint)


def _check_linger(scope: Scope) -> None:
    if scope.is_user and is_lingering(scope) is False:
        hint = f"on that machine, as root: {linger_command(scope)}"
        raise bad_input("the user there does not linger, so it would end with this session", hint)


def _wait_for_address(request: MemberRequest, is_passing: bool) -> None:
    """Wait until this machine has its address, whose network may come up late."""
    addresses, deadline = request.start.addresses, time.monotonic() + request.address_seconds
    while addresses and not is_own(addresses[0]):
        if time.monotonic() > deadline:
            hint = "see machines in dora-systemd.yml(5): address"
            code = ExitCode.FAILURE if is_passing else ExitCode.BAD_INPUT
            raise DoraSystemdError(f"it has no address {addresses[0]}", hint, code)
        time.sleep(_LOOK_SECONDS)


def _end_old_part(manager: Manager, request: MemberRequest) -> None:
    """End a part of the same dataflow whose head has started a new run.

    A part of a former start, with another UUID, ends by itself if its head is gone.
    """
    cell = read_cell(manager, request.unit)
    if cell is None or not cell.options.machine:
        return
    if cell.uuid == request.start.uuid and cell.has_begun:
        manager.run_jobs("StopUnit", [request.unit])
    elif cell.state.active == "deactivating":
        _wait_for_end(manager, request)


def _wait_for_end(manager: Manager, request: MemberRequest) -> None:
    deadline = time.monotonic() + request.end_seconds
    while not _is_down(manager, request.unit):
        if time.monotonic() > deadline:
            message = f"cannot start {request.unit}: its former part is still being stopped"
            hint = f"see systemctl {request.scope.flag} status {request.unit} on that machine"
            raise DoraSystemdError(message, hint)
        time.sleep(_LOOK_SECONDS)


def _member_plan(plan: Plan, part: Part) -> Plan:
    """The head owns restarts and the time of a start.

    Its runner can shorten the grace duration of the settings, which its doractl and this machine
    have given. Longer, it could keep this machine from a shutdown.
    """
    options = plan.options.with_value("restart_policy", "no")._replace(
        start_timeout=INFINITY, grace=min(part.grace, plan.options.grace)
    )
    return plan._replace(options=options)


def _check_same(part: Part, plan: Plan) -> None:
    """Raise DoraSystemdError unless both machines have the same file and the same doractl.

    The runner checks the version of dora, which root must not execute.
    """
    if version_numbers(part.doractl)[:2] != version_numbers(__version__)[:2]:
        hint = "install the same version of dora-systemd on both machines"
        there = plain(part.doractl)
        raise bad_input(f"it has dora-systemd {__version__}, the head has {there}", hint)
    path = plan.options.dataflow
    if hashlib.sha256(read_file(path).data).hexdigest() != part.digest:
        raise bad_input(format_other_file(path), COPY_HINT)


def _start_transient(
    manager: Manager, unit: str, properties: Sequence[tuple[str, str, object]]
) -> None:
    try:
        manager.start_transient(unit, properties, None, wait=False)
    except DoraSystemdError as error:
        if error.code is ExitCode.NAME_IN_USE:
            # The session before this one was just starting it: it ends with that session.
            raise DoraSystemdError(error.message, error.hint) from error
        raise


def _connected(part: Part) -> tuple[socket.socket, socket.socket]:
    """A connection to a runner that is yet to start, and what it shall have as standard input.

    The runner finds the other end of the connection there, see runner/machines/boot.py.
    """
    own, theirs = socket.socketpair()
    giving, stdin = socket.socketpair()
    own.settimeout(_START_SECONDS)
    with theirs, giving:
        own.sendall(format_message(part))
        socket.send_fds(giving, [b"\n"], [theirs.fileno()])
    return own, stdin


def _first_answer(manager: Manager, unit: str, runner: socket.socket) -> bytes:
    """The first line of the runner, which has got its part. Raises DoraSystemdError."""
    deadline = time.monotonic() + _START_SECONDS
    # systemd keeps the runner's end of the connection if it cannot execute the runner.
    while not _says_something(runner) and time.monotonic() < deadline:
        if _is_down(manager, unit):
            raise _failure(manager, unit)
    line = _first_line(runner)
    if not line.endswith(b"\n"):
        while not _is_down(manager, unit) and time.monotonic() < deadline:
            time.sleep(_LOOK_SECONDS)  # the unit has the reason only when it is down
        raise _failure(manager, unit)
    return line


def _says_something(runner: socket.socket) -> bool:
    return bool(select.select([runner], [], [], _LOOK_SECONDS)[0])


def _is_down(manager: Manager, unit: str) -> bool:
    return is_at_rest(manager.read(unit, ["Job", "ActiveState"]))


def _failure(manager: Manager, unit: str) -> DoraSystemdError:
    """Return the error with the reason why the runner has ended."""
    refusal = runners_refusal(manager, unit)
    return refusal or DoraSystemdError(f"cannot start {unit}: {failure_reason(manager, unit)}")


def _first_line(runner: socket.socket, seconds: float = _START_SECONDS) -> bytes:
    """Without its end if it does not come: a byte now and then must not keep root's process."""
    with suppress(OSError):
        return read_line(runner.fileno(), time.monotonic() + seconds)
    return b""


class Head:
    """The connection to the head over two file descriptors. The context sends heartbeats.

    line_seconds: timeout of each line until the Part, because the head may be busy with its start.
    """

    line_seconds = 30.0
    most_seconds = 60.0

    def __init__(self, reading: int = 0, writing: int = 1) -> None:
        self._reading, self._writing = reading, writing
        self._lock = Lock()
        self._over = Event()
        self._beats = Thread(target=self._beat, daemon=True)

    def __enter__(self) -> "Head":
        self._beats.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._beats.join()

    def part(self) -> Part:
        """Receive the Part. Raises DoraSystemdError (FAILURE) if the head sends none."""
        most = time.monotonic() + self.most_seconds
        while True:
            deadline = min(most, time.monotonic() + self.line_seconds)
            line = read_line(self._reading, deadline)
            if not line.endswith(b"\n") and len(line) < MAX_LINE:
                raise _silent()
            message = parse_message(line)
            if not isinstance(message, Beat):
                return expect(message, Part)

    def tell(self, message: Message) -> None:
        """Send a message, if the head is still connected."""
        self.say(format_message(message))

    def say(self, line: bytes) -> None:
        """Send a whole line, if the head is still connected."""
        with self._lock, suppress(OSError):
            os.write(self._writing, line)

    def _beat(self) -> None:
        while not self._over.is_set():
            self.tell(Beat())
            self._over.wait(BEAT_SECONDS)


def read_line(fd: int, deadline: float, most: int = MAX_LINE) -> bytes:
    """Read one line, and not a byte more: what follows is for the relay.

    The line has no end if the input ends, at `deadline` (seconds of the monotonic clock), or after
    `most` bytes. Raises OSError.
    """
    line = b""
    while not line.endswith(b"\n") and len(line) < most:
        seconds = max(deadline - time.monotonic(), 0)
        byte = os.read(fd, 1) if select.select([fd], [], [], seconds)[0] else b""
        if not byte:
            break
        line += byte
    return line


def _silent() -> DoraSystemdError:
    hint = "doractl start on the head starts the members"
    return DoraSystemdError("cannot run a member: no head says what to run", hint)

"""What the head knows of its members, and its connections to them.

Each member is a session at the head's socket, which the link to that machine begins.
"""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from functools import partial

from dora_systemd import __version__
from dora_systemd.adapters.runner_socket.client import Request
from dora_systemd.adapters.runner_socket.listener import Ends, refuse
from dora_systemd.decisions.cell.machines import (
    NOT_CONNECTED,
    NOT_JOINED,
    USUAL,
    members_of,
    placed_on,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.machines.address import endpoint
from dora_systemd.decisions.machines.usage import merged
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input, usage_error, words_of
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.machines.boot import GREETED, forwards
from dora_systemd.runner.machines.lines import Lines
from dora_systemd.runner.nodes.watchdog import monotonic_us
from dora_systemd.terminal_text import short_line
from dora_systemd.values import quoted

_SILENT_BEATS = 3
"""Beats without a message after which a member may be gone, and dora gets no request for it."""
_REFRESH_SECONDS = 0.5
"""The table of the head is written at most so often because of the members."""
_HUNG = ("node-hung", "node-watchdog")
_MOST_TAKEN = 4
"""Attempts in a row with ports that are taken on some machine."""
_LONGEST = 300
_LOOK_SECONDS = 0.02
_CHECK_SECONDS = 30.0
"""Time for a member to check its part: its dora may have to read the descriptor."""
_CONNECT_SECONDS = 3.0
_ENDLESS = 2**62
"""µs."""

Endpoints = Mapping[str, tuple[str, int]]
"""Address and port by machine."""


class Member:
    """The state of one member, as the head knows it."""

    def __init__(self) -> None:
        self.lines: Lines | None = None  # the connection, if there is one
        self.work = ""  # dora's directory on that machine, "" until the member is ready
        self.words = NOT_CONNECTED  # why the member is not ready
        self.table = CellStatus()  # of the member's nodes
        self.has_left = False  # the member has reported a clean end
        self.is_over = False  # it has reported an end, and is not ready again in this connection
        self.failed = 0  # attempts to connect in a row that have failed
        self.checked: wire.Checked | None = None  # the answer to the last Check, if received

    @property
    def is_heard(self) -> bool:
        """Whether a message from the member arrived within the last _SILENT_BEATS heartbeats."""
        return self.lines is not None and self.lines.silent < _SILENT_BEATS


def _refusal(name: str, member: Member) -> DoraSystemdError | None:
    if (told := member.checked) is not None:
        reason, hint = short_line(told.reason, _LONGEST), short_line(told.hint, _LONGEST)
        error = bad_input(f"machine {name}: {reason}", hint)
        return error if reason else None
    reason = "it does not answer" if member.work else member.words
    message = f"cannot reach machine {name}: {reason}"
    return DoraSystemdError(message, "a start would wait for that machine", ExitCode.NO_HOST)


def with_dues(table: CellStatus) -> CellStatus:
    """The table of a member, whose clock has another zero: it sends the time that is left.

    The table of the head must not get a number that no reader accepts.
    """
    now, left = monotonic_us(), table.stop_dues.items()
    return table._replace(stop_dues={node: now + one for node, one in left if one < _ENDLESS})


class Roster:
    """All members of a dataflow, and the connections to them."""

    def __init__(self, options: RunnerOptions, ports: wire.Forwards) -> None:
        self._options, self._ports = options, ports
        self._members = {name: Member() for name in members_of(options.placed)}
        self._token = self._digest = self._dora = ""
        self.changed = asyncio.Event()  # something is new of a member
        self.lost: frozenset[str] = frozenset()  # the members lost in the run before this one
        # Whether a person waits for this start, and can repair what a machine at its boot cannot.
        self.is_awaited = self._is_closed = False
        self._taken = 0
        self.pids: dict[str, int] = {}  # by node, there: of the last process that dora reported
        # Takes the events; set before the first connection.
        self.push: Callable[[life.Event], None] = lambda _: None
        # Takes the digests of what the nodes of a member run.
        self.on_programs: Callable[[str, str], None] = lambda _name, _digests: None
        # Writes the table of the head again, because that of a member is new.
        self.refresh: Callable[[], None] = lambda: None
        self._is_refreshing = False

    @property
    def names(self) -> tuple[str, ...]:
        """The members in the order of the dataflow."""
        return tuple(self._members)

    def set_facts(self, digest: str, dora: str, is_awaited: bool) -> None:
        """Set what members compare: see wire.Part."""
        self._digest, self._dora, self.is_awaited = digest, dora, is_awaited

    def close(self) -> None:
        """Refuse new links: the run is about to end, and the next run has other ports."""
        self._is_closed = True

    def begin_again(self, ports: wire.Forwards, lost: frozenset[str]) -> None:
        """End the connections of the last run, because another run begins in this process."""
        self._ports, self._token, self._is_closed, self.lost = ports, "", False, lost
        for member in self._members.values():
            lines, member.lines = member.lines, None
            if lines is not None:
                lines.end("the run has ended")
            member.work, member.has_left, member.failed = "", False, 0

    def set_token(self, token: str) -> None:
        """Send the Part to the connected members, now that the coordinator listens."""
        self._token = token
        for name in self._members:
            self._send_part(name)

    def works(self) -> Mapping[str, str]:
        """Return dora's directory on each machine."""
        return {name: one.work for name, one in self._members.items()}

    def endpoints(self) -> Endpoints:
        """Return where zenoh of each machine listens, with `link: direct`."""
        addresses = dict(zip(self._members, self._options.addresses[1:], strict=False))
        return {name: (one, self._ports.zenoh[name]) for name, one in addresses.items()}

    def missing(self) -> dict[str, str]:
        """Return the members that are not ready, and why."""
        return {name: one.words for name, one in self._members.items() if not one.work}

    def silent(self) -> list[str]:
        """Return the members that may be gone."""
        return [name for name, one in self._members.items() if not one.is_heard]

    def gone(self) -> list[str]:
        """Return the members without a connection: it has ended, if only by the lease."""
        return [name for name, one in self._members.items() if one.lines is None]

    def tell(self, message: wire.Message, machine: str = "") -> None:
        """Send a message to all connected members, or to the one with that name."""
        for name, one in self._members.items():
            if one.lines is not None and machine in ("", name):
                one.lines.send(message)

    async def find_refusal(
        self, digest: str, seconds: float = _CHECK_SECONDS
    ) -> DoraSystemdError | None:
        """Return the error of the first member that could not start again or does not answer.

        digest: of the descriptor, see wire.Check.
        """
        for member in self._members.values():
            member.checked = None
        self.tell(wire.Check(digest))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while any(one.checked is None and one.work for one in self._members.values()):
                    await asyncio.sleep(_LOOK_SECONDS)
        refusals = (_refusal(name, one) for name, one in self._members.items())
        return next(filter(None, refusals), None)

    def has_heard(self, machine: str, event: life.NodeAsked) -> bool:
        """Return whether the table of a machine contains the request of `event`."""
        node = self._members[machine].table.nodes.get(event.node)
        return node is not None and (node.asked, node.asked_by) == (event.what, event.by)

    def amend(self, table: CellStatus) -> CellStatus:
        """Return the table of the head, with the members' rows for their nodes."""
        return merged(table, {name: one.table for name, one in self._members.items()})

    async def link(self, request: Request, ends: Ends) -> None:
        """Serve the session of a link."""
        name = str(request.get("machine"))
        if name not in self._members:
            message = f"machine {quoted(name)} has no node of this dataflow"
            await refuse(ends, usage_error(message))
            return
        if self._is_closed:
            await refuse(ends, DoraSystemdError("the run ends", "the next one has other ports"))
            return
        lines = Lines(ends)
        self._replace(name, lines)
        if not request.get(GREETED):
            lines.send(forwards(self._options, self._ports))
        self._send_part(name)
        why = await lines.talk(partial(self._hear, name, lines))
        if self._members[name].lines is lines:
            self._lose(name, why, lines.is_broken)

    def _replace(self, name: str, lines: Lines) -> None:
        member = self._members[name]
        if (old := member.lines) is not None:
            # A link that tries again is no reason why a member is not ready: the first one stays.
            self._lose(name, "it has a new link" if member.work else member.words)
            old.end("there is a new link")
        member.lines, member.is_over = lines, False

    def _send_part(self, name: str) -> None:
        lines, options = self._members[name].lines, self._options
        if lines is None or not self._token:
            return
        if self._members[name].words == NOT_CONNECTED:
            # Else the last error of ssh, or the reason of the loss, explains more.
            self._members[name].words = NOT_JOINED
        lines.send(
            wire.Part(
                name=options.name,
                uuid=options.uuid,
                machine=name,
                token=self._token,
                coordinator=self._ports.coordinator,
                zenoh=self._ports.zenoh[name],
                digest=self._digest,
                grace=options.grace,
                doractl=__version__,
                dora=self._dora,
                again=int(not self.is_awaited),
            )
        )
        self.changed.set()

    def _lose(self, name: str, why: str, is_failure: bool = False) -> None:
        """Record the end of a connection. A reason from the link or the member takes precedence."""
        member = self._members[name]
        was_ready, member.lines, member.table = bool(member.work), None, CellStatus()
        if was_ready or member.words in USUAL:
            member.words = why
        member.work = ""
        if was_ready and not member.has_left:
            self.push(life.MachineLost(now_us(), name, why, is_failure=is_failure))
        self.changed.set()

    def _hear(self, name: str, lines: Lines, message: wire.Message) -> None:
        if self._members[name].lines is not lines:
            return
        if isinstance(message, wire.Ready):
            self._ready(name, message)
        elif isinstance(message, wire.Table):
            self._members[name].table = with_dues(CellStatus.from_json(message.status))
            self._refresh_soon()
        elif isinstance(message, wire.Programs | wire.Hung | wire.Checked):
            self._hear_of_files_and_nodes(name, message)
        elif isinstance(message, wire.Refused):
            self._give_up(name, message, Cause.MACHINE_REFUSES)
        elif isinstance(message, wire.Ended):
            self._ended(name, message)
        elif isinstance(message, wire.Lost) and not self._members[name].has_left:
            has_failed = message.words == wire.RUNNER_ENDED
            self._ended(name, wire.Ended(message.words, failed=int(has_failed)))
        elif isinstance(message, wire.Unreached):
            self._unreached(name, message)
        elif isinstance(message, wire.Taken):
            self._take_others(name, message)

    def _hear_of_files_and_nodes(
        self, name: str, message: wire.Programs | wire.Hung | wire.Checked
    ) -> None:
        if isinstance(message, wire.Programs):
            self.on_programs(name, message.digests)
        elif isinstance(message, wire.Checked):
            self._members[name].checked = message
        else:
            self._hung(name, message)

    def _hung(self, name: str, message: wire.Hung) -> None:
        """Push NodeHung, if the node is the member's own and the event is a known one."""
        is_own = placed_on(self._options.placed, message.node) == name
        if is_own and message.record in _HUNG:
            reason = short_line(message.reason, _LONGEST)
            is_late = message.pid not in (0, self.pids.get(message.node, message.pid))
            event = life.NodeHung(now_us(), message.node, reason, message.record, is_late=is_late)
            self.push(event)

    def _take_others(self, name: str, message: wire.Taken) -> None:
        """Start a new run with other ports, or give up after _MOST_TAKEN attempts in a row."""
        self._taken += 1
        if self._taken < _MOST_TAKEN:
            self.push(life.ReloadAsked(now_us()))
        else:
            cause = Cause.NO_MACHINE if self.is_awaited else Cause.MACHINE_LOST
            self._give_up(name, message, cause)

    def _refresh_soon(self) -> None:
        if not self._is_refreshing:
            self._is_refreshing = True
            asyncio.get_running_loop().call_later(_REFRESH_SECONDS, self._refresh)

    def _refresh(self) -> None:
        self._is_refreshing = False
        self.refresh()

    def _ready(self, name: str, message: wire.Ready) -> None:
        if not message.work.startswith("/"):
            raise DoraSystemdError("its directory is not absolute")
        if (member := self._members[name]).work or member.is_over:
            return
        member.work, member.has_left, member.failed = message.work, False, 0
        self._taken = 0
        self.push(life.MachineJoined(now_us(), name))
        self.changed.set()

    def _unreached(self, name: str, message: wire.Unreached) -> None:
        """Fail the start if retrying cannot help; otherwise count a failed attempt."""
        member = self._members[name]
        member.failed += 1
        if not message.tries or (self.is_awaited and member.failed >= message.tries):
            self._give_up(name, message, Cause.NO_MACHINE)
        else:
            self._ended(name, wire.Ended(message.reason))

    def _give_up(
        self, name: str, message: wire.Refused | wire.Unreached | wire.Taken, cause: Cause
    ) -> None:
        hint = f"; hint: {short_line(message.hint, _LONGEST)}" if message.hint else ""
        reason = f"machine {name}: {short_line(message.reason, _LONGEST)}{hint}"
        self.push(life.Refused(now_us(), reason, cause))

    def _ended(self, name: str, message: wire.Ended) -> None:
        """Handle the reason of a member's end or a lost link; the end of the connection follows."""
        reason, by = (short_line(one, _LONGEST) for one in (message.reason, message.by))
        member = self._members[name]
        if not reason and not by:
            member.has_left = True
            return
        was_ready, member.work, member.is_over = bool(member.work), "", True
        member.words = reason or f"it was stopped there by {by}"
        if was_ready or by:
            facts = member.words, by, bool(message.failed), bool(message.waits)
            self.push(life.MachineLost(now_us(), name, *facts))
        self.changed.set()


async def find_unreached(endpoints: Endpoints) -> dict[str, str]:
    """Find the machines whose zenoh cannot be reached, and why: only with `link: direct`.

    dora starts a run even if no messages can pass: a firewall between daemons is no error to dora.
    So the head connects before each run; zenoh logs no connection that ends at once.
    """
    found = await asyncio.gather(*(_problem(*one) for one in endpoints.values()))
    return {name: why for name, why in zip(endpoints, found, strict=True) if why}


async def _problem(address: str, port: int) -> str:
    try:
        async with asyncio.timeout(_CONNECT_SECONDS):
            _, writer = await asyncio.open_connection(address, port)
        writer.close()
    except TimeoutError:
        return f"cannot connect to {endpoint(address, port)}: timed out"
    except OSError as error:
        return f"cannot connect to {endpoint(address, port)}: {words_of(error)}"
    return ""

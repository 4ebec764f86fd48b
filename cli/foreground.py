"""Prints the logs of a dataflow until it ends: `doractl run` and `doractl start --attach`."""

import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from dora_systemd.adapters.bus.manager import Beside, Property
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.cli.parameters import print_warnings
from dora_systemd.cli.terminal import StageLine, wants_colors
from dora_systemd.decisions.logs.records import DoraLines, LogFilter, Record
from dora_systemd.decisions.logs.terminal import TerminalLines
from dora_systemd.scope import scope_of
from dora_systemd.values import INFINITY
from dora_systemd.verbs.logs import FollowedLog, Write
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.run import SIGNALS, follow_unit, require_executed
from dora_systemd.verbs.start.start_unit import start_unit

if TYPE_CHECKING:
    from dora_systemd.verbs.remote.attached import MemberLines, SharedLog

FORMATS = ("pretty", "json", "compact")
"""The formats of `dora run --log-format`."""

_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class Foreground:
    """The output of an attached dataflow, and what stops the dataflow."""

    shown: LogFilter = field(default_factory=LogFilter)
    form: str = FORMATS[0]
    signals: Sequence[signal.Signals] = SIGNALS  # as for follow_unit()
    stop_after: int = INFINITY  # as for follow_unit()
    notes: Sequence[str] = ()  # human-readable, printed once the dataflow has been accepted
    command: str = "doractl run"  # for the journal
    links: Beside = ()  # as for start_unit()


def print_until_end(
    bus: Bus, plan: Plan, properties: Sequence[Property] | None, how: Foreground
) -> int:
    """Start a plan, and print its logs until it has ended; its exit status.

    properties: as for start_unit(). Raises DoraSystemdError if the dataflow is refused.
    """
    lines, options = _lines(how.form, plan), plan.options
    since = time.time_ns() // _MICROSECOND_NS
    with StageLine(sys.stderr) as stage:

        def write(data: bytes) -> None:
            stage.wipe()
            sys.stdout.buffer.write(data)
            sys.stdout.buffer.flush()

        def form(record: Record) -> bytes:
            return lines.record(record) if how.shown.shows(record) else b""

        def warn(text: str) -> None:
            stage.wipe()
            print_warnings([text])

        followed = FollowedLog(plan.scope, options.name, options.uuid, since, write, form)
        with closing(_shared(followed, write, form) if options.placed else followed) as logs:
            start_unit(bus, plan.scope, options, properties, stage, False, how.links)
            stage.wipe()
            print_warnings(how.notes)
            if not isinstance(logs, FollowedLog):
                logs.others = _members(bus, plan, since, warn)
            by = partial(note_request, "stop-asked", options.name, options.uuid, how.command)
            status = follow_unit(bus, plan.unit, logs, stage, how.signals, how.stop_after, by)
    require_executed(plan.scope, options.name, status)
    return status


def _shared(head: FollowedLog, write: Write, form: Callable[[Record], bytes]) -> "SharedLog":
    from dora_systemd.verbs.remote.attached import SharedLog

    return SharedLog(head, write, form)


def _members(
    bus: Bus, plan: Plan, since: int, warn: Callable[[str], object]
) -> "list[MemberLines]":
    """The lines of the other machines, as far as this user has keys for these."""
    from dora_systemd.verbs.facts.machines import member_hosts
    from dora_systemd.verbs.remote.attached import MemberLines

    options = plan.options
    hosts = member_hosts(bus, options)
    if plan.scope != scope_of(None):
        warn(f"the lines of {', '.join(hosts)} are left out: use sudo")
        return []
    return [
        MemberLines(
            host._replace(text=name),
            (options.name, options.uuid),
            [one.node for one in options.placed if one.machine == name],
            since,
            warn,
        )
        for name, host in hosts.items()
        if host
    ]


def _lines(form: str, plan: Plan) -> TerminalLines | DoraLines:
    is_terminal = sys.stdout.isatty()
    if form == FORMATS[0]:
        return TerminalLines(want_colors=wants_colors(sys.stdout), is_terminal=is_terminal)
    return DoraLines(form, plan.options.uuid, is_terminal)

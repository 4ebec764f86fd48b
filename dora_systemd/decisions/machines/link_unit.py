"""The unit of a link: its name and its properties. Pure."""

import signal
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.machines import members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.link_command import (
    LinkOptions,
    link_command,
    parse_link_command,
)
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.properties.assignments import typed, with_assignments, with_properties
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.decisions.unit.file import HEADER
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import bad_input
from dora_systemd.names import LINK_PREFIX, SLICE, UNIT_SUFFIX, unit_name
from dora_systemd.values import SECOND

_BETWEEN = ":"
"""The separator occurs in no name of a dataflow or machine, so two links have different units."""
_WATCHDOG = 25 * SECOND
"""µs without a WATCHDOG=1 of a link: longer than all waits of a link, also on a busy machine."""
_MOST = 255
"""Bytes of a unit's name, see systemd.unit(5)."""

_ALL = (
    "NoNewPrivileges=yes",
    # Not yes, see decisions/properties/sandbox.py.
    "RestrictNamespaces=uts",
    "RestrictSUIDSGID=yes",
    "RestrictRealtime=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
    # Its memory has the token for a moment.
    "LimitCORE=0",
)
# It reads root's keys and ssh_config(5), and connects to sockets of the nodes' user.
_SYSTEM = (
    "CapabilityBoundingSet=CAP_DAC_OVERRIDE CAP_DAC_READ_SEARCH",
    "ProtectSystem=strict",
    "ProtectHome=read-only",
    "PrivateTmp=yes",
    "PrivateDevices=yes",
    "ProtectClock=yes",
    "ProtectControlGroups=yes",
    "ProtectHostname=yes",
    "ProtectKernelLogs=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelTunables=yes",
    "ProtectProc=invisible",
)


class LinkUnit(NamedTuple):
    """The unit of one link: its name, and its properties by slot."""

    unit: str
    properties: dict[str, Property]


def link_unit_name(name: str, machine: str) -> str:
    """The unit of the link to `machine`. Raises DoraSystemdError (BAD_INPUT) if it is too long."""
    unit = f"{LINK_PREFIX}{name}{_BETWEEN}{machine}{UNIT_SUFFIX}"
    if len(unit) > _MOST:
        reason = f"a unit's name has at most {_MOST} characters"
        message = f"cannot link {name} to machine {machine}: {reason}"
        raise bad_input(message, "choose a shorter --name")
    return unit


def link_units_of(options: RunnerOptions) -> list[str]:
    """The links of a dataflow whose head has these options; none on a member."""
    if options.machine:
        return []
    return [link_unit_name(options.name, one) for one in members_of(options.placed)]


def links_pattern(name: str) -> str:
    """A pattern for all links of a dataflow."""
    return f"{LINK_PREFIX}{name}{_BETWEEN}*{UNIT_SUFFIX}"


def wanted_links(options: RunnerOptions) -> dict[str, Property]:
    """Return the properties of the head's unit by which any start of it starts the links."""
    links = tuple(link_units_of(options))
    return typed(Wants=links) if links else {}


def link_unit(
    python: str,
    socket: str,
    options: RunnerOptions,
    member: Member,
    is_user: bool,
    identity: str = "",
) -> LinkUnit:
    """The unit of the link to a member.

    python: absolute path of the interpreter of dora-systemd. socket: of the head's runner.
    identity: the file with the key of the machine, or "" for the keys of the account.
    StopWhenUnneeded= stops the link with the head's unit, but not while that waits for its restart.
    A shutdown of the machine stops the head first, which notifies the members.
    """
    link = LinkOptions(socket, member.machine, member.host.text, member.words, identity)
    argv = link_command(python, link)
    own = typed(
        Description=f"link of dora dataflow {options.name} to machine {member.machine}",
        Slice=SLICE,
        # Not exec: the unit of the head would wait for the sandbox of this one.
        Type="simple",
        ExecStart=((argv[0], tuple(argv), ("no-env-expand",)),),
        Before=(unit_name(options.name),),
        After=("network.target",),
        StopWhenUnneeded=True,
        Restart="always",
        RestartSec=SECOND,
        StartLimitIntervalSec=0,
        WatchdogSec=_WATCHDOG,
        # A process that is stopped, or waits in the kernel, takes no other signal.
        WatchdogSignal=signal.SIGKILL,
        WorkingDirectory="/",
        TimeoutStopSec=5 * SECOND,
        SyslogIdentifier=options.name,
    )
    sandbox = with_assignments({}, (*_ALL, *(() if is_user else (*_SYSTEM, *_log(options)))))
    return LinkUnit(link_unit_name(options.name, member.machine), with_properties(own, sandbox))


def link_file(link: LinkUnit) -> str:
    """Format the unit file of a link, for a head that is started at boot and wants the link."""
    return HEADER + format_unit(link.properties)


def link_from_command(
    python: str, argv: Sequence[str], options: RunnerOptions, is_user: bool
) -> LinkUnit:
    """The unit of a link from its ExecStart=. Raises DoraSystemdError (USAGE) for another one."""
    link = parse_link_command(argv)
    member = Member(link.machine, parse_host(link.host), link.words)
    return link_unit(python, link.socket, options, member, is_user, link.identity)


def _log(options: RunnerOptions) -> Iterator[str]:
    yield f"LogExtraFields=DORA_DATAFLOW={options.uuid}"
    yield f"LogExtraFields=DORA_DATAFLOW_NAME={options.name}"

"""Drops properties that older versions of systemd lack, with warnings.

Not used of newer versions, even if they are there: RESTART_RESET=1 (258) would also set NRestarts=
to 0, and the runner resets its delay itself, see dora_systemd.runner.cell.restarts.
ConcurrencySoftMax= (258) counts active units, so with 4 in dora.slice no fifth dataflow would start
before one of the others ends. OOMKills (259) is of a whole unit, and the runner reads the counters
of each node.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from dora_systemd.decisions.properties.assignments import Properties
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.values import quoted

Told = tuple[str, str, Any]
"""A property on D-Bus: name, signature and value."""

MIN_VERSION = 252
"""The version in Debian 12: the first one with everything that a cell needs."""

_ADDED: Mapping[int, tuple[str, ...]] = {
    253: ("MemoryZSwapMax", "LogFilterPatterns"),
    254: (
        *("RestartMode", "RestartSteps", "RestartMaxDelayUSec", "FileDescriptorStorePreserve"),
        *("DelegateSubgroup", "DefaultStartupMemoryLow", "StartupMemoryLow", "StartupMemoryHigh"),
        *("StartupMemoryMax", "StartupMemorySwapMax", "StartupMemoryZSwapMax", "ImportCredential"),
        *("MemoryPressureWatch", "MemoryPressureThresholdUSec", "RootEphemeral", "MemoryKSM"),
        *("RootImagePolicy", "MountImagePolicy", "ExtensionImagePolicy"),
    ),
    255: ("SurviveFinalKillSignal", "SetLoginEnvironment", "CoredumpReceive"),
    256: ("WantsMountsFor", "MemoryZSwapWriteback"),
    257: (
        *("PrivateTmpEx", "BindLogSockets", "ProtectControlGroupsEx"),
        *("PrivateUsersEx", "PrivatePIDs", "ManagedOOMMemoryPressureDurationUSec"),
    ),
}
"""Names on D-Bus by the first version that has them: HISTORY in org.freedesktop.systemd1(5)."""

_SINCE = {name: version for version, names in _ADDED.items() for name in names}

_KEEPS_COMMANDS = 257
r"""The first version tested that can read the command lines of transient units back. 252 writes
ExecStartEx=, which it does not know, and "\\$" for a "$": after the next daemon-reload the unit has
no command line, or a different one."""

_PLAIN_FLAGS = frozenset({"ignore-failure", "no-env-expand"})

_SILENT = {
    # The runner creates the group and moves into it if systemd does not.
    "DelegateSubgroup": "supervisor",
    # RECORDER in dora-systemd-nodes(7) has what a recorder lacks without it.
    "FileDescriptorStorePreserve": "yes",
    # The sandbox uses this value if possible, see dora-systemd-security(7).
    "PrivateUsers": "identity",
}
"""Values of ours that are left out without a warning."""


def drop_unsupported(
    properties: Properties, systemd_version: int, given: tuple[str, ...] = ()
) -> tuple[dict[str, Property], tuple[str, ...]]:
    """The properties that this systemd supports, and a warning for each other one that matters.

    given: the assignments of --property, whose values are not ours.
    Raises DoraSystemdError (NO_SYSTEMD) below version 252.
    """
    if systemd_version < MIN_VERSION:
        message = f"cannot use systemd {systemd_version}: it is too old"
        hint = f"dora-systemd needs systemd {MIN_VERSION} or newer"
        raise DoraSystemdError(message, hint, ExitCode.NO_SYSTEMD)
    keys = {one.partition("=")[0] for one in given}
    kept = {slot: one for slot, one in properties.items() if _since(one) <= systemd_version}
    dropped = {slot: one for slot, one in properties.items() if slot not in kept}
    warnings = tuple(
        f"{slot.removesuffix('~')}= is left out: systemd {systemd_version} lacks it, "
        f"version {_since(one)} has it"
        for slot, one in dropped.items()
        if one.value != _SILENT.get(slot) or slot in keys
    )
    return kept, warnings


def lacking(systemd_version: int) -> list[str]:
    """Names on D-Bus of the properties that this systemd does not support."""
    return [name for name, version in _SINCE.items() if version > systemd_version]


def transient_commands(properties: Iterable[Told], systemd_version: int) -> list[Told]:
    """The properties of a transient unit, with command lines that survive a daemon-reload.

    Raises DoraSystemdError (USAGE) for command lines that do not, with this version.
    """
    if systemd_version >= _KEEPS_COMMANDS:
        return [*properties]
    return [_plain_commands(one, systemd_version) for one in properties]


def _plain_commands(one: Told, systemd_version: int) -> Told:
    """ExecStart instead of ExecStartEx: without a "$" they are equivalent."""
    name, signature, commands = one
    if signature != "a(sasas)":
        return one
    for _, argv, flags in commands:
        if {*flags} - _PLAIN_FLAGS or re.search(r"[$`]", "".join(argv)):
            key, words = name.removesuffix("Ex"), quoted(" ".join(argv))
            message = f"cannot keep {key}={words} over a reload of systemd {systemd_version}"
            hint = 'use paths without "$", and command lines without "+" and "!"'
            raise usage_error(message, hint)
    plain = tuple((path, argv, "ignore-failure" in flags) for path, argv, flags in commands)
    return name.removesuffix("Ex"), "a(sasb)", plain


def _since(one: Property) -> int:
    """The first version of systemd that supports this property."""
    return _SINCE.get(one.name.removesuffix("Scale"), MIN_VERSION)

"""What older versions of systemd lack: dropped from a unit in a pass of its own, with warnings."""

from collections.abc import Mapping

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.propertykinds import Property
from dora_systemd.propertyset import Properties

MIN_VERSION = 252
"""Debian 12's: the first with all that a cell cannot do without."""

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
"""Names on D-Bus by the version that has them first: HISTORY in org.freedesktop.systemd1(5)."""

_SINCE = {name: version for version, names in _ADDED.items() for name in names}

# The runner makes the group and moves into it where systemd does not.
_REPLACED = frozenset({"DelegateSubgroup"})


def drop_unsupported(
    properties: Properties, systemd_version: int
) -> tuple[dict[str, Property], tuple[str, ...]]:
    """The properties that this systemd knows, and one warning for each other one that matters.

    Raises DoraSystemdError (NO_SYSTEMD) below version 252.
    """
    if systemd_version < MIN_VERSION:
        message = f"cannot use systemd {systemd_version}: it is too old"
        hint = f"dora-systemd needs systemd {MIN_VERSION} or newer"
        raise DoraSystemdError(message, hint, ExitCode.NO_SYSTEMD)
    kept = {slot: one for slot, one in properties.items() if _since(one) <= systemd_version}
    dropped = {slot: one for slot, one in properties.items() if slot not in kept}
    warnings = tuple(
        f"{slot.removesuffix('~')}= is left out: systemd {systemd_version} lacks it, "
        f"version {_since(one)} has it"
        for slot, one in dropped.items()
        if slot not in _REPLACED
    )
    return kept, warnings


def lacking(systemd_version: int) -> list[str]:
    """Names on D-Bus of the properties that this systemd does not know."""
    later = (names for version, names in _ADDED.items() if version > systemd_version)
    return [name for names in later for name in names]


def _since(one: Property) -> int:
    """The first version of systemd that takes this property."""
    return _SINCE.get(one.name.removesuffix("Scale"), MIN_VERSION)

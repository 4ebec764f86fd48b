"""The unit that runs the command of a notice: as the nodes run, with bounds of its own. Pure."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.names import SLICE
from dora_systemd.values import SECOND

SECONDS = 30
"""Time for a notice; systemd then kills it."""
MOST_MEMORY = "128M"
MOST_LINES = 100
JSON = "why.json"

_ALWAYS = ("CapabilityBoundingSet", "UMask", "RestrictNamespaces")
"""Copied even if they are 0, which means none."""
_COPIED = (
    *_ALWAYS,
    *("User", "Group", "SupplementaryGroups", "LoadCredential", "LoadCredentialEncrypted"),
    *("NoNewPrivileges", "RestrictSUIDSGID", "LockPersonality", "MemoryDenyWriteExecute"),
    *("SystemCallArchitectures", "SystemCallFilter", "SystemCallErrorNumber"),
    *("RestrictAddressFamilies", "RestrictRealtime", "ProtectSystem", "ProtectHome"),
    *("ProtectKernelTunables", "ProtectKernelModules", "ProtectKernelLogs", "ProtectClock"),
    *("ProtectHostname", "ProtectProc", "ProcSubset", "PrivateIPC", "PrivateTmp", "PrivateUsers"),
    *("PrivateNetwork", "NetworkNamespacePath", "IPAddressAllow", "IPAddressDeny"),
    *("PrivateDevices", "DevicePolicy", "DeviceAllow", "TemporaryFileSystem"),
    *("ReadWritePaths", "ReadOnlyPaths", "InaccessiblePaths", "BindPaths", "BindReadOnlyPaths"),
)
"""Properties on D-Bus that a notice has in common with the nodes: user, sandbox, credentials."""
_EXTENDED = "Ex"
"""Newer versions of systemd have more values in a second property, such as PrivateUsersEx."""


class NoticeUnit(NamedTuple):
    """What the unit of a notice is made of."""

    name: str  # of the dataflow
    uuid: str
    words: tuple[str, ...]  # the command, with an absolute path
    directory: str  # the working directory of the nodes
    environment: tuple[str, ...]  # KEY=VALUE, that of the nodes and that of the notice
    stdin: str  # path of the file for standard input, which only the manager's user can read
    evidence: str  # path of the file for the credential why.json
    cell_directory: str  # the RuntimeDirectory of the dataflow, which is gone after a failure
    is_user: bool


def names_to_copy(types: Mapping[str, str]) -> list[str]:
    """The properties to read of the dataflow's unit. types: signatures by name, of this systemd."""
    extended = (f"{one}{_EXTENDED}" if f"{one}{_EXTENDED}" in types else one for one in _COPIED)
    return [one for one in extended if one in types]


def notice_properties(
    unit: NoticeUnit, copied: Mapping[str, Any], types: Mapping[str, str]
) -> list[Property]:
    """The properties of the unit. copied: what names_to_copy() names, as read from systemd.

    systemd opens the file for standard input before it takes on the user, so no other user can
    read what nodes have written. A unit that fails starts nothing: there is no OnFailure=.
    """
    own = typed(
        Description=f"notice of dora dataflow {unit.name}",
        Slice=SLICE,
        Type="oneshot",
        ExecStart=((unit.words[0], unit.words, ("no-env-expand",)),),
        WorkingDirectory=f"-{unit.directory}",
        Environment=unit.environment,
        SyslogIdentifier=f"{unit.name}/on_failure",
        TimeoutStartSec=SECONDS * SECOND,
        TimeoutStopSec=2 * SECOND,
    )
    limits = [f"MemoryMax={MOST_MEMORY}", "MemorySwapMax=0", "TasksMax=64", "LimitCORE=0"]
    bounds = with_assignments({}, [*limits, *([] if unit.is_user else _log(unit))])
    files = [
        Property("StandardInputFile", "s", unit.stdin),
        *([] if unit.is_user else [_credential(unit, copied)]),
    ]
    return [*own.values(), *bounds.values(), *files, *_of_nodes(unit, copied, types)]


def _log(unit: NoticeUnit) -> Iterator[str]:
    yield f"LogExtraFields=DORA_DATAFLOW={unit.uuid}"
    yield f"LogExtraFields=DORA_DATAFLOW_NAME={unit.name}"
    yield f"LogRateLimitIntervalSec={SECONDS}s"
    yield f"LogRateLimitBurst={MOST_LINES}"


def _credential(unit: NoticeUnit, copied: Mapping[str, Any]) -> Property:
    given = [(key, path) for key, path in copied.get("LoadCredential") or () if key != JSON]
    return Property("LoadCredential", "a(ss)", (*given, (JSON, unit.evidence)))


def _of_nodes(
    unit: NoticeUnit, copied: Mapping[str, Any], types: Mapping[str, str]
) -> Iterator[Property]:
    for key, value in copied.items():
        if key == "LoadCredential" and not unit.is_user:
            continue
        if key.startswith("Bind"):
            # A path that has gone since must not keep the notice from running.
            value = [
                (source, place, True, flags)
                for source, place, _, flags in value
                if source != unit.cell_directory
            ]
        if key in _ALWAYS or not _is_empty(value):
            yield Property(key, types[key], value)


def _is_empty(value: Any) -> bool:
    return not value or (isinstance(value, list | tuple) and list(value) == [False, []])

"""The transient units of builds.

The unit of a release's build has the user, the sandbox and the network of the dataflow's unit. What
is different: a build may write the tree that it builds, and sees no other release; it has no
credentials, no rights of single nodes, and few CPU shares compared with running dataflows.
"""

from collections.abc import Mapping

from dora_systemd.decisions.cell.environment import environment_entries
from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.structs import MS_REC
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.decisions.releases.entries import MOST_BYTES
from dora_systemd.values import INFINITY, SECOND

_OF_NODES = (
    *(
        "LoadCredential",
        "ImportCredential",
        "LogRateLimit",
        "CPUScheduling",
        "IOScheduling",
        "Nice",
    ),
    *("CPUWeight", "IOWeight", "StartupCPU", "StartupIO", "LimitRTPRIO", "LimitNICE", "KillMode"),
    *("OOMScoreAdjust", "AmbientCapabilities", "TasksMax", "Environment"),
)
"""Prefixes of the properties that a build must not have, or has other values of."""
_SHARES = 10
"""CPUWeight= and IOWeight=; the default of all others is 100."""
_STOP = 5 * SECOND
_MOST_TASKS = 4096
_MEMORY = "50%"


def build_properties(
    own: Mapping[str, Property],
    tree: str,
    place: str,
    releases: str,
    environment: Mapping[str, str],
    timeout: int,
    is_user: bool,
) -> dict[str, Property]:
    """Return all properties but ExecStart= and standard input.

    own: of the unit of the dataflow, without those of its runner. tree: the directory that is
    built, which the unit sees as `place`, below `releases`. timeout: µs.
    """
    kept = {slot: one for slot, one in own.items() if not _is_of_nodes(slot)}
    if not any(slot.startswith("MemoryMax") for slot in kept):
        kept = with_assignments(kept, [f"MemoryMax={_MEMORY}"])
    binds, hidden = (_values(kept, key) for key in ("BindPaths", "TemporaryFileSystem"))
    kept |= _of_builds(environment) | typed(
        NotifyAccess="main",
        # A venv and a program can contain the path that they were built at.
        TemporaryFileSystem=(*hidden, (releases, "ro")),
        BindPaths=(*binds, (tree, place, False, MS_REC)),
        TimeoutStartSec=timeout,
        LimitFSIZE=MOST_BYTES,
    )
    # A user's manager has no mounts without a user namespace, see systemd.exec(5).
    return with_assignments(kept, ["PrivateUsers=yes"]) if is_user else kept


def project_build_properties(user: str, environment: Mapping[str, str]) -> dict[str, Property]:
    """The properties of a build of a project where it is, but ExecStart= and the streams.

    It has the rights of `user` and no sandbox, as if that user had built: caches in the home
    directory count.
    """
    own = typed(User=user, NoNewPrivileges=True, TimeoutStartSec=INFINITY)
    return _of_builds(environment) | own


def _of_builds(environment: Mapping[str, str]) -> dict[str, Property]:
    """The properties of every build."""
    return typed(
        Type="oneshot",
        WorkingDirectory="/",
        Environment=environment_entries(environment),
        TimeoutStopSec=_STOP,
        KillMode="control-group",
        CPUWeight=_SHARES,
        IOWeight=_SHARES,
        TasksMax=_MOST_TASKS,
    )


def _is_of_nodes(slot: str) -> bool:
    """Whether it has such a prefix, or is of [Unit]: a build starts no other units."""
    row = TABLE.get(slot.removesuffix("~").removesuffix("Soft"))
    return slot.startswith(_OF_NODES) or (row is not None and row.section == "Unit")


def _values(properties: Mapping[str, Property], key: str) -> tuple[object, ...]:
    return tuple(properties[key].value) if key in properties else ()

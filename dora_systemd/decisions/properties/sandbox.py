"""What a dataflow is kept from: a level and a few choices become unit properties.

Every property is one of systemd.exec(5) or systemd.resource-control(5). What each costs is in the
table SANDBOX of dora-systemd(7).

systemd mounts as root, at every start and restart: BindPaths= follows the links that it finds, and
ReadWritePaths= is a mount, too, with a moment between the look and the mount. A link in a directory
of the nodes' user would have it mount what lies below another user's closed home, past the
permissions of that home. To check again does not help. So no path is mounted that has a component
which anybody but root can replace, but the part of it before that: a whole home for a project in
it. Where that part is a place to be hidden, such as /tmp, the place stays open.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from dora_systemd.decisions.properties.assignments import parse_property, with_properties
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.structs import MS_REC
from dora_systemd.values import format_bool

LEVELS = ("none", "default", "strict")
NETWORKS = ("host", "loopback", "private")

DEFAULT_LEVEL = "default"
DEFAULT_NETWORK = "host"

# Filters of system calls and flags of processes: the kernel lets every user set them.
_CALLS = (
    "NoNewPrivileges=yes",
    # To make the one that is left needs a capability that nodes do not have. systemd 257 writes a
    # transient unit with none left as an empty line, which it reads back as all.
    "RestrictNamespaces=uts",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "SystemCallErrorNumber=EPERM",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
)
# What is done with mounts, capabilities and BPF needs the system's manager. A user's manager would
# need user namespaces, and would fail where the kernel or a container does not let it have them.
_FILES = (
    "ProtectSystem=strict",
    "ProtectKernelTunables=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelLogs=yes",
    "ProtectClock=yes",
    "ProtectHostname=yes",
    "ProtectProc=invisible",
)
# No ProtectControlGroups=: the runner makes a group for each node.
_STRICT_CALLS = ("MemoryDenyWriteExecute=yes", "UMask=0077", "SystemCallFilter=~@privileged")
_STRICT_FILES = ("ProcSubset=pid", "PrivateIPC=yes")

_TEMPORARY = ("/tmp", "/var/tmp")
_HOMES = ("/home", "/root", "/run/user")
_MOUNTABLE = re.compile(r"[^\s\x00-\x1f\x7f\"'\\:]+")


@dataclass(frozen=True)
class Sandbox:
    """The choices.

    level: one of LEVELS. network: one of NETWORKS. is_user: of a user's manager.
    is_root: the nodes run as root. has_devices: some are allowed by name.
    is_realtime: the nodes are scheduled so. has_identity: the user can be
    in a namespace with the first 65536 ids.
    needed: absolute paths that are read, such as the project. writable: those that are written.
    firm: by path of these two, the part of it that only root can replace; else all of it.
    directory: the RuntimeDirectory of the unit, the only one of its kind that nodes see; "": all.
    """

    level: str = DEFAULT_LEVEL
    network: str = DEFAULT_NETWORK
    is_user: bool = False
    is_root: bool = False
    has_devices: bool = False
    is_realtime: bool = False
    has_identity: bool = True
    needed: Sequence[str] = ()
    writable: Sequence[str] = ()
    firm: Mapping[str, str] = field(default_factory=dict)
    directory: str = ""

    @property
    def has_mounts(self) -> bool:
        """Whether anything is hidden at all."""
        return self.level != "none" and not self.is_user

    def mounted(self, paths: Iterable[str]) -> list[str]:
        """What systemd is told of these paths."""
        return list(dict.fromkeys(self.firm.get(path, path) for path in paths))


def sandbox_properties(sandbox: Sandbox) -> dict[str, Property]:
    """The properties by key of the unit file."""
    properties: dict[str, Property] = {}
    for assignment in _assignments(sandbox):
        properties = with_properties(properties, parse_property(assignment))
    return properties | _path_properties(sandbox)


def odd_paths(sandbox: Sandbox) -> list[str]:
    """The paths that keep whole places of the machine open: systemd cannot mount them alone."""
    if not sandbox.has_mounts:
        return []
    paths = _unmountable(sandbox.mounted((*sandbox.needed, *sandbox.writable)))
    return [path for path in paths if _is_below(path, _hideable(sandbox))]


def loose_paths(sandbox: Sandbox) -> Iterator[tuple[str, str]]:
    """Paths that somebody else than root can replace, and the place that stays open for each."""
    if sandbox.has_mounts:
        for path in dict.fromkeys((*sandbox.needed, *sandbox.writable)):
            firm = sandbox.firm.get(path, path)
            for place in _hideable(sandbox):
                if _is_below(path, [place]) and path != place and _is_below(place, [firm]):
                    yield path, place


def widened_paths(sandbox: Sandbox) -> Iterator[tuple[str, str]]:
    """Paths that are to be written, and the larger part of the machine that is written for each."""
    if sandbox.has_mounts:
        loose = dict(loose_paths(sandbox))
        for path in sandbox.writable:
            if sandbox.firm.get(path, path) != path and path not in loose:
                yield path, sandbox.firm[path]


def _hideable(sandbox: Sandbox) -> tuple[str, ...]:
    return (*_TEMPORARY, *(_HOMES if sandbox.level == "strict" else ()))


def _assignments(sandbox: Sandbox) -> list[str]:
    found = _network(sandbox)
    if sandbox.level == "none":
        return found
    is_strict = sandbox.level == "strict"
    found += _CALLS
    found += _STRICT_CALLS if is_strict else ()
    if not sandbox.is_realtime:
        # A process of a realtime dataflow may order its own threads.
        found += ["RestrictRealtime=yes"]
        found += ["SystemCallFilter=~@resources"] if is_strict else []
    if not sandbox.is_user:
        found += [*_FILES, _devices(sandbox), *_privileges(sandbox)]
        found += _STRICT_FILES if is_strict else ()
    return found


def _network(sandbox: Sandbox) -> list[str]:
    if sandbox.network == "private":
        return ["PrivateNetwork=yes"]
    if sandbox.network == "loopback" and not sandbox.is_user:
        return ["IPAddressDeny=any", "IPAddressAllow=localhost"]
    return []


def _devices(sandbox: Sandbox) -> str:
    # PrivateDevices= hides all but /dev/null and its like, also those that are allowed.
    return "DevicePolicy=closed" if sandbox.has_devices else "PrivateDevices=yes"


def _privileges(sandbox: Sandbox) -> list[str]:
    if sandbox.is_root:
        # Who asks for root wants every file; in a user namespace it would be root of its own only.
        return ["CapabilityBoundingSet=CAP_DAC_OVERRIDE CAP_DAC_READ_SEARCH"]
    return ["CapabilityBoundingSet=", *_users(sandbox)]


def _users(sandbox: Sandbox) -> list[str]:
    """A user namespace: else ptrace(2) and /proc show a dataflow all others of the same user.

    ProtectProc= hides what cannot be traced, which also spares dora's daemon most of its work: it
    reads all processes that it sees, every two seconds. With "identity" files keep their owners.
    """
    if sandbox.level == "strict":
        return ["PrivateUsers=yes"]
    return ["PrivateUsers=identity"] if sandbox.has_identity else []


def _path_properties(sandbox: Sandbox) -> dict[str, Property]:
    """What is hidden and what stays: private directories, and mounts of what is needed in them."""
    if not sandbox.has_mounts:
        return {}
    needed, writable = sandbox.mounted(sandbox.needed), sandbox.mounted(sandbox.writable)
    hides_tmp = _can_hide(_TEMPORARY, (*needed, *writable))
    hides_home = sandbox.level == "strict" and _can_hide(_HOMES, (*needed, *writable))
    hidden = (*(_TEMPORARY if hides_tmp else ()), *(_HOMES if hides_home else ()))
    # Without temporary directories of their own the nodes write to the machine's.
    shared = () if hides_tmp else _TEMPORARY
    bound = [path for path in writable if _is_below(path, hidden)]
    written = [path for path in writable if path not in bound]
    read = [path for path in needed if _is_below(path, hidden)]
    own = [sandbox.directory] if sandbox.directory else []
    return {
        **parse_property(f"ProtectHome={'tmpfs' if hides_home else 'read-only'}"),
        **parse_property(f"PrivateTmp={format_bool(hides_tmp)}"),
        **(_empty_but(sandbox.directory) if own else {}),
        **_words("ReadWritePaths", (*shared, *written)),
        **_binds("BindPaths", [*bound, *own]),
        **_binds("BindReadOnlyPaths", [path for path in read if not _is_below(path, bound)]),
    }


def _empty_but(directory: str) -> dict[str, Property]:
    """Nothing beside the cell's own directory: others of the same user have their tokens there."""
    return parse_property(f"TemporaryFileSystem={directory.rpartition('/')[0]}:ro")


def _can_hide(places: Iterable[str], paths: Sequence[str]) -> bool:
    """Whether nobody wants a whole place, and all that is needed in it can be mounted."""
    wants_whole = any(_is_below(place, paths) for place in places)
    return not wants_whole and not any(_is_below(one, places) for one in _unmountable(paths))


def _unmountable(paths: Iterable[str]) -> list[str]:
    """The paths that systemd 257 writes into a transient unit in a way that it reads otherwise.

    The unit would be without that mount, or with another, from the next daemon-reload on.
    """
    return [path for path in paths if not _MOUNTABLE.fullmatch(path)]


def _is_below(path: str, places: Iterable[str]) -> bool:
    """Whether `path` is one of `places` or in one of them."""
    return any(f"{path}/".startswith(f"{place.rstrip('/')}/") for place in places)


def _words(key: str, paths: Iterable[str]) -> dict[str, Property]:
    words = tuple(dict.fromkeys(paths))
    return {key: Property(key, "as", words)} if words else {}


def _binds(key: str, paths: Sequence[str]) -> dict[str, Property]:
    outer = [one for one in dict.fromkeys(paths) if not _is_below(one, {*paths} - {one})]
    binds = tuple((path, path, False, MS_REC) for path in outer)
    return {key: Property(key, "a(ssbt)", binds)} if binds else {}

"""The sandbox of a dataflow: turns a level and a few options into unit properties.

Every property is one of systemd.exec(5) or systemd.resource-control(5). The table SANDBOX of
dora-systemd-security(7) lists what each of them restricts.

systemd mounts as root, at every start and restart. BindPaths= follows links, and ReadWritePaths= is
a mount too, with a delay between check and mount. A link in a directory of the nodes' user could
make it mount something below another user's closed home, past the permissions of that home.
Checking again does not help. So if others than root can replace a component of a path, only the
part before that component is mounted: a whole home for a project in it. If that part would have to
be hidden, such as /tmp, it stays accessible.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.structs import MS_REC
from dora_systemd.values import format_bool

LEVELS = ("none", "default", "strict")
NETWORKS = ("host", "loopback", "private")

DEFAULT_LEVEL = "default"
DEFAULT_NETWORK = "host"

# Filters of system calls and process flags, which the kernel allows every user to set.
_CALLS = (
    "NoNewPrivileges=yes",
    # Allow uts: to create one needs a capability that nodes lack. systemd 257 writes a transient
    # unit without any type as an empty line, and reads that back as all types.
    "RestrictNamespaces=uts",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "SystemCallErrorNumber=EPERM",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
)
_CAN = "RestrictAddressFamilies=AF_CAN"
"""It adds to the families of _CALLS."""
# Mounts, capabilities and BPF need the system manager. A user's manager would need user namespaces,
# and fail if the kernel or a container does not allow them.
_FILES = (
    "ProtectSystem=strict",
    "ProtectKernelTunables=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelLogs=yes",
    "ProtectClock=yes",
    "ProtectHostname=yes",
    "ProtectProc=invisible",
)
# Not ProtectControlGroups=: the runner creates a cgroup for each node.
_STRICT_CALLS = ("MemoryDenyWriteExecute=yes", "UMask=0077", "SystemCallFilter=~@privileged")
_STRICT_FILES = ("ProcSubset=pid", "PrivateIPC=yes")

_TEMPORARY = ("/tmp", "/var/tmp")
_HOMES = ("/home", "/root", "/run/user")
_MOUNTABLE = r"[^\s\x00-\x1f\x7f\"'\\:]+"


class Sandbox(NamedTuple):
    """The options of a sandbox."""

    level: str = DEFAULT_LEVEL  # one of LEVELS
    network: str = DEFAULT_NETWORK  # one of NETWORKS
    is_user: bool = False  # of a user's manager
    is_root: bool = False  # the nodes run as root
    has_devices: bool = False  # some devices are allowed by name
    has_can: bool = False  # the nodes use a CAN bus
    is_realtime: bool = False  # the nodes have realtime scheduling
    has_rights: bool = False  # some node has rights that a program sets before it
    has_identity: bool = True  # the user fits into a namespace with the first 65536 ids
    needed: Sequence[str] = ()  # absolute paths to read, such as the project
    writable: Sequence[str] = ()  # paths to write
    # by path of `needed` and `writable`, the part that only root can replace; all without an entry
    firm: Mapping[str, str] = {}
    # the RuntimeDirectory of the unit, the only one that nodes see; "": all are visible
    directory: str = ""
    denied: Sequence[str] = ()  # paths to write that the nodes' user, `user`, must not write
    user: str = ""

    @property
    def has_mounts(self) -> bool:
        """Whether the sandbox hides anything."""
        return self.level != "none" and not self.is_user

    def mounted(self, paths: Iterable[str]) -> list[str]:
        """The paths as they are passed to systemd."""
        return list(dict.fromkeys(self.firm.get(path, path) for path in paths))


def sandbox_properties(sandbox: Sandbox) -> dict[str, Property]:
    """The properties by key of the unit file."""
    return with_assignments({}, _assignments(sandbox)) | _path_properties(sandbox)


def odd_paths(sandbox: Sandbox) -> list[str]:
    """Paths that keep a whole directory accessible, because systemd cannot mount them alone."""
    if not sandbox.has_mounts:
        return []
    paths = _unmountable(sandbox.mounted((*sandbox.needed, *sandbox.writable)))
    return [path for path in paths if _is_below(path, _hideable(sandbox))]


def loose_paths(sandbox: Sandbox) -> Iterator[tuple[str, str]]:
    """Paths that others than root can replace, and the directory that stays accessible for each."""
    if sandbox.has_mounts:
        for path in dict.fromkeys((*sandbox.needed, *sandbox.writable)):
            firm = sandbox.firm.get(path, path)
            for place in _hideable(sandbox):
                if _is_below(path, [place]) and path != place and _is_below(place, [firm]):
                    yield path, place


def widened_paths(sandbox: Sandbox) -> Iterator[tuple[str, str]]:
    """Paths to write, and the larger directory that becomes writable for each."""
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
    found += [_CAN] if sandbox.has_can else []
    if not sandbox.is_realtime:
        # A realtime dataflow may change the scheduling of its threads.
        found += ["RestrictRealtime=yes"]
        found += ["SystemCallFilter=~@resources"] if is_strict and not sandbox.has_rights else []
    if not sandbox.is_user:
        # PrivateDevices= hides all devices but /dev/null and similar ones, even allowed devices.
        devices = "DevicePolicy=closed" if sandbox.has_devices else "PrivateDevices=yes"
        found += [*_FILES, devices, *_privileges(sandbox)]
        found += _STRICT_FILES if is_strict else ()
    return found


def _network(sandbox: Sandbox) -> list[str]:
    if sandbox.network == "private":
        return ["PrivateNetwork=yes"]
    if sandbox.network == "loopback" and not sandbox.is_user:
        return ["IPAddressDeny=any", "IPAddressAllow=localhost"]
    return []


def _privileges(sandbox: Sandbox) -> list[str]:
    """No capabilities, and a user namespace, unless the nodes run as root.

    In a namespace ptrace(2) and /proc only show the dataflow's own processes. Otherwise they show
    all processes of the same user. ProtectProc= hides what cannot be traced, which also saves CPU
    time of dora's daemon: it reads all visible processes every two seconds. With "identity" files
    keep their owners.
    """
    if sandbox.is_root:
        # Nodes as root need access to all files; in a user namespace they would be root only there.
        return ["CapabilityBoundingSet=CAP_DAC_OVERRIDE CAP_DAC_READ_SEARCH"]
    if sandbox.level == "strict":
        return ["CapabilityBoundingSet=", "PrivateUsers=yes"]
    return ["CapabilityBoundingSet=", *(["PrivateUsers=identity"] if sandbox.has_identity else [])]


def _path_properties(sandbox: Sandbox) -> dict[str, Property]:
    """The hidden directories, and mounts of the needed paths in them."""
    if not sandbox.has_mounts:
        return {}
    needed, writable = sandbox.mounted(sandbox.needed), sandbox.mounted(sandbox.writable)
    hides_tmp = _can_hide(_TEMPORARY, (*needed, *writable))
    hides_home = sandbox.level == "strict" and _can_hide(_HOMES, (*needed, *writable))
    hidden = (*(_TEMPORARY if hides_tmp else ()), *(_HOMES if hides_home else ()))
    # Without private temporary directories, nodes write to the machine's.
    shared = () if hides_tmp else _TEMPORARY
    bound = [path for path in writable if _is_below(path, hidden)]
    written = [path for path in writable if path not in bound]
    read = [path for path in needed if _is_below(path, hidden)]
    own = [sandbox.directory] if sandbox.directory else []
    texts = [
        f"ProtectHome={'tmpfs' if hides_home else 'read-only'}",
        f"PrivateTmp={format_bool(hides_tmp)}",
        # Hide other cells' directories: those of the same user contain their tokens.
        *(f"TemporaryFileSystem={directory.rpartition('/')[0]}:ro" for directory in own),
    ]
    lists = typed(
        ReadWritePaths=tuple(dict.fromkeys((*shared, *written))),
        BindPaths=_binds([*bound, *own]),
        BindReadOnlyPaths=_binds([path for path in read if not _is_below(path, bound)]),
    )
    return with_assignments({}, texts) | {key: one for key, one in lists.items() if one.value}


def _can_hide(places: Iterable[str], paths: Sequence[str]) -> bool:
    """Whether no path is a whole place, and all needed paths in the places can be mounted."""
    wants_whole = any(_is_below(place, paths) for place in places)
    return not wants_whole and not any(_is_below(one, places) for one in _unmountable(paths))


def _unmountable(paths: Iterable[str]) -> list[str]:
    """Paths that systemd 257 writes into a transient unit and reads back differently.

    After the next daemon-reload the unit would lack that mount, or have another one.
    """
    return [path for path in paths if not re.fullmatch(_MOUNTABLE, path)]


def _is_below(path: str, places: Iterable[str]) -> bool:
    """Whether `path` is one of `places` or below one of them."""
    return any(f"{path}/".startswith(f"{place.rstrip('/')}/") for place in places)


def _binds(paths: Sequence[str]) -> tuple[tuple[str, str, bool, int], ...]:
    outer = [one for one in dict.fromkeys(paths) if not _is_below(one, {*paths} - {one})]
    return tuple((path, path, False, MS_REC) for path in outer)

"""Containers that nodes start: which process is a client, and which cgroup the container has. Pure.

conmon(8), which stays with a container of podman, has the ID in its arguments, and is the parent of
the first process in the container. It is in the cgroup of the node, or in a scope of its own. Which
of the latter belongs to a client in the cgroup of a node is known by the name, or by the time: the
first that began after the client. Clients of docker and nerdctl only talk to a daemon: the first
container that began after such a client is taken for its container.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any, NamedTuple

from dora_systemd.values import format_rounded_size

MONITOR, PODMAN = "conmon", "podman"
CLIENTS = (PODMAN, "docker", "nerdctl")
_VERBS = ("run", "start", "compose")
_MOST_OPTIONS = 8
_ID = r"[0-9a-f]{64}"
_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}"
_GROUP = r"(?:[a-z-]{1,32}-)?([0-9a-f]{64})(?:\.scope)?"
_SHORT = 12
MOST_WAIT = 600.0
"""Seconds in which a client may fetch an image before its container begins."""


class Client(NamedTuple):
    """A process of a node that has a container, or starts one."""

    pid: int
    program: str  # MONITOR, or one of CLIENTS
    id: str = ""  # of the container, if the arguments have it
    name: str = ""
    began: float = 0.0  # seconds since the boot
    uid: int = -1
    parent: int = 0
    is_split: bool = False  # whether podman puts the container below the cgroup of its caller


class Container(NamedTuple):
    """A container that a node has started."""

    program: str  # podman, docker or nerdctl
    id: str = ""  # 64 hexadecimal digits, "" if the container is not known
    name: str = ""
    group: str = ""  # its cgroup, "" if that is not known
    memory: int | None = None
    is_inside: bool = False  # whether it is in the cgroup of the node, whose limits hold then
    user: str = ""  # whose podman has it, "" for root's and the caller's

    def __str__(self) -> str:
        if not self.id:
            return f"a container of {self.program} that is not known"
        name = f" {self.name}" if self.name else ""
        size = f", {format_rounded_size(self.memory)}" if self.memory else ""
        return f"{self.program} container{name} ({self.id[:_SHORT]}{size})"

    @property
    def remedy(self) -> str:
        """The command that stops it: root's podman has other containers, also of that name."""
        command = f"{self.program} stop {self.name or self.id[:_SHORT]}"
        command += f", as {self.user}" if self.user else ""
        return command if self.id else ""

    @property
    def labels(self) -> dict[str, str]:
        return {"program": self.program, "container": self.name or self.id[:_SHORT]}

    def values(self) -> dict[str, Any]:
        return {
            "program": self.program,
            "id": self.id or None,
            "name": self.name or None,
            "cgroup": self.group or None,
            "memory_bytes": self.memory,
            "inside": self.is_inside,
        }


def client_of(pid: int, arguments: Sequence[str]) -> Client | None:
    """The client that a process is, by its arguments; None for another process."""
    program = PurePosixPath(arguments[0]).name if arguments else ""
    options = dict(reversed([*pairwise(arguments)]))  # the first of each counts
    if program == MONITOR:
        id, name = options.get("-c", ""), options.get("-n", "")
        return Client(pid, program, id, _name(name)) if re.fullmatch(_ID, id) else None
    if program in CLIENTS and {*arguments[1:_MOST_OPTIONS]} & {*_VERBS}:
        joined = (one.removeprefix("--name=") for one in arguments if one.startswith("--name="))
        is_split = "--cgroups=split" in arguments or options.get("--cgroups") == "split"
        name = _name(options.get("--name", next(joined, "")))
        return Client(pid, program, name=name, is_split=is_split)
    return None


def _name(text: str) -> str:
    return text if re.fullmatch(_NAME, text) else ""


def id_of_group(group: str) -> str:
    """The ID of the container whose cgroup this is, or is below; "" for another group."""
    found = (re.fullmatch(_GROUP, part) for part in reversed(group.split("/")))
    return next((match[1] for match in found if match), "")


def may_be_of_daemon(name: str) -> bool:
    """Whether the last part of a cgroup is that of a container of docker or nerdctl."""
    return bool(id_of_group(name)) and not name.startswith("libpod")


def whole_group(group: str) -> str:
    """The outermost cgroup of the container whose cgroup this is, or is below."""
    parts = group.split("/")
    for count, part in enumerate(parts, 1):
        if re.fullmatch(_GROUP, part):
            return "/".join(parts[:count])
    return group


def container_of(client: Client, group: str, own: str) -> Container:
    """The container of a client of podman. group: of its first process. own: of the node."""
    is_inside = PurePosixPath(group).is_relative_to(own) if group else False
    if group and not is_inside and id_of_group(group) != client.id:
        # A process that only claims to be a monitor must not name the container of another user.
        return Container("podman", group=group)
    return Container("podman", client.id, client.name, whole_group(group), None, is_inside)


def own_monitors(clients: Sequence[Client], monitors: Sequence[Client]) -> list[Client]:
    """The monitors of a node: those in its cgroup, and those of its clients of podman.

    clients: the processes in the cgroup of the node. monitors: those of this machine.
    """
    found = [one for one in clients if one.program == MONITOR]
    podmans = {one.pid: one for one in clients if one.program == PODMAN}
    for one in podmans.values():
        # Without root, podman executes itself again in a user namespace.
        if one.parent not in podmans and (monitor := _monitor_of(one, monitors, found)):
            found.append(monitor)
    return list({one.id: one for one in found}.values())


def _monitor_of(
    client: Client, monitors: Sequence[Client], found: Sequence[Client]
) -> Client | None:
    hits = [one for one in monitors if one.uid == client.uid and one.began >= client.began]
    if client.name:
        return next((one for one in hits if one.name == client.name), None)
    own = {one.id for one in found}
    in_time = (one for one in hits if one.began - client.began <= MOST_WAIT)
    # One that is in the cgroup of the node, too, is found already.
    first = min(in_time, key=lambda one: one.began, default=None)
    return None if first is None or first.id in own else first


def match_clients(
    clients: Sequence[Client],
    begun: Mapping[str, float],
    makers: Mapping[str, int | None],
    known: Collection[str] = (),
) -> list[Container]:
    """The container of each client of a daemon, by the times of their beginnings.

    begun: when the first process in each cgroup of a container began. makers: the uids that can
    have made these cgroups; any user can make one whose name is that of another container. known:
    IDs of containers that belong to others.
    """
    left = sorted((at, group) for group, at in begun.items() if id_of_group(group) not in known)
    found = []
    for one in sorted(clients, key=lambda client: client.began):
        hits = [
            (at, group)
            for at, group in left
            if 0 <= at - one.began <= MOST_WAIT and makers.get(group) in (0, one.uid)
        ]
        if not hits:
            found.append(Container(one.program))
            continue
        left.remove(hits[0])
        group = hits[0][1]
        found.append(Container(one.program, id_of_group(group), group=group))
    return found


def format_outside(containers: Mapping[str, Sequence[Container]]) -> str:
    """Format the containers outside of the cgroups of their nodes, by node; "" without any."""
    parts = [
        f"{node}: {one}" for node, some in containers.items() for one in some if not one.is_inside
    ]
    return f"{', '.join(parts)}; no limit of a node holds there" if parts else ""


def format_left(containers: Sequence[tuple[str, Container]]) -> str:
    """Format what a stop has left, each with its node; "" for nothing."""
    if not containers:
        return ""
    names = ", ".join(f"{one} of {node}" for node, one in containers)
    verb = "runs" if len(containers) == 1 else "run"
    commands = "; ".join(one.remedy for _, one in containers if one.remedy)
    return f"{names} still {verb}{commands and f', run: {commands}'}"

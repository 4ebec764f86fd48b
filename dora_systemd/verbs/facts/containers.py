"""The containers that nodes have started: in the cgroup of the node, or outside of it.

Nothing is asked of podman or docker: a socket of theirs is its owner's, and as good as root.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.host.clients import (
    process_start,
    read_children,
    read_clients,
    read_monitors,
)
from dora_systemd.adapters.host.process_table import PROC, process_group
from dora_systemd.decisions.resources.containers import (
    MONITOR,
    PODMAN,
    Client,
    Container,
    container_of,
    format_left,
    match_clients,
    may_be_of_daemon,
    own_monitors,
)
from dora_systemd.decisions.resources.usage import WHOLE_CELL
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.paths import other_user

_MOST_GROUPS = 10_000

Containers = Mapping[str, tuple[Container, ...]]
"""Containers by node."""


def read_containers(groups: Mapping[str, Path], proc: Path = PROC) -> Containers:
    """The containers of the nodes with these groups; {} if no process of a node is a client."""
    clients = {
        node: read_clients(cgroup.some_pids(path), proc)
        for node, path in groups.items()
        if node != WHOLE_CELL
    }
    clients = {node: some for node, some in clients.items() if some}
    if not clients:
        return {}
    programs = {one.program for some in clients.values() for one in some}
    every = read_monitors(proc) if PODMAN in programs else ()
    monitors = {node: own_monitors(some, every) for node, some in clients.items()}
    pids = [one.pid for some in monitors.values() for one in some]
    children = read_children(pids, proc) if pids else {}
    found = {
        node: [_of_monitor(one, children, groups[node], proc) for one in some]
        for node, some in monitors.items()
    }
    if programs - {MONITOR, PODMAN}:
        _add_of_daemons(found, clients, proc)
    return {node: tuple(map(_with_memory, some)) for node, some in found.items() if some}


def _of_monitor(
    client: Client, children: Mapping[int, Sequence[int]], own: Path, proc: Path
) -> Container:
    place = f"/{own.relative_to(cgroup.mount_point())}"
    pids = children.get(client.pid, ())
    inner = next((group for pid in pids if (group := process_group(pid, proc))), "")
    return container_of(client, inner, place)._replace(user=other_user(client.uid))


def _add_of_daemons(
    found: Mapping[str, list[Container]], clients: Mapping[str, Sequence[Client]], proc: Path
) -> None:
    """Add the containers of docker and nerdctl."""
    known = [one.id for some in found.values() for one in some]
    groups = cgroup.find_groups(may_be_of_daemon, _MOST_GROUPS)
    begun = {group: at for group in groups if (at := _begun(group, proc))}
    makers = {group: cgroup.maker_of(cgroup.group_path(group)) for group in begun}
    for node, some in clients.items():
        others = [one for one in some if one.program not in (MONITOR, PODMAN)]
        found[node] += match_clients(others, begun, makers, known)
        known += [one.id for one in found[node]]


def _begun(group: str, proc: Path) -> float:
    """When the first process in a group began, 0 without any."""
    pids = cgroup.some_pids(cgroup.group_path(group))
    return min(filter(None, (process_start(pid, proc) for pid in pids)), default=0.0)


def _with_memory(one: Container) -> Container:
    if not one.group:
        return one
    return one._replace(memory=cgroup.read_usage(cgroup.group_path(one.group)).memory)


def outside_of(manager: Manager, unit: str, proc: Path = PROC) -> list[tuple[str, Container]]:
    """The containers of a dataflow that its unit does not end, each with its node."""
    group = str(manager.read(unit, ["ControlGroup"])["ControlGroup"])
    if not group:
        return []
    path = cgroup.group_path(group)
    found = read_containers(cgroup.shown_groups(path), proc)
    return [
        (node, one)
        for node, some in found.items()
        for one in some
        if one.group and not cgroup.group_path(one.group).is_relative_to(path)
    ]


def outside_of_node(manager: Manager, unit: str, node: str, proc: Path = PROC) -> "Outside":
    """The containers of one node that do not end with the node."""
    found = find_outside(manager, [unit], proc)
    return {unit: [one for one in some if one[0] == node] for unit, some in found.items()}


Outside = Mapping[str, Sequence[tuple[str, Container]]]
"""Containers with their nodes, by unit."""


def find_outside(manager: Manager, units: Iterable[str], proc: Path = PROC) -> Outside:
    """The containers that do not end with these units, without units that have none."""
    found = {}
    for unit in units:
        with suppress(DoraSystemdError):
            found[unit] = outside_of(manager, unit, proc)
    return {unit: some for unit, some in found.items() if some}


def with_left(outcomes: Iterable[Outcome], outside: Outside) -> list[Outcome]:
    """The outcomes of stops, with the containers that still run."""
    return [_with_left(one, left_of(outside.get(one.subject.unit, ()))) for one in outcomes]


def _with_left(one: Outcome, left: Sequence[tuple[str, Container]]) -> Outcome:
    if not left:
        return one
    values = [{"node": node, **container.values()} for node, container in left]
    text = f"{one.text}; {format_left(left)}"
    return one._replace(text=text, details={**one.details, "left": values})


def left_of(containers: Iterable[tuple[str, Container]]) -> list[tuple[str, Container]]:
    """The containers that still run, with the memory that they have now."""
    return [
        (node, _with_memory(one))
        for node, one in containers
        if cgroup.is_populated(cgroup.group_path(one.group))
    ]

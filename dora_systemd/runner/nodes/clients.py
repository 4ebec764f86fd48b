"""Notices containers that nodes start outside of their cgroups, for the journal."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.host.process_table import PROC, beginning
from dora_systemd.decisions.life.states import Record

PROGRAMS = (b"podman", b"docker", b"nerdctl")


class ClientWatch:
    """Checks each process of a node once: most processes are no clients."""

    def __init__(self, proc: Path = PROC) -> None:
        self._proc = proc
        self._seen: frozenset[int] = frozenset()

    def look(self, groups: Mapping[str, Path]) -> list[Record]:
        """Return an event for each client that has begun. groups: of the nodes."""
        pids = {node: frozenset(cgroup.pids(path)) for node, path in groups.items()}
        new = {node: sorted(some - self._seen) for node, some in pids.items()}
        self._seen = frozenset().union(*pids.values())
        return [one for node, some in new.items() for one in self._records(node, some)]

    def _records(self, node: str, pids: list[int]) -> Iterator[Record]:
        if not (clients := [pid for pid in pids if self._is_client(pid)]):
            return
        # Imported late: few nodes start containers.
        from dora_systemd.adapters.host.clients import read_clients

        for one in read_clients(clients, self._proc):
            # Without root, podman executes itself again in a user namespace.
            if not (one.is_split or one.parent in clients):
                yield Record(
                    "container-outside", node, {"program": one.program, "container": one.name}
                )

    def _is_client(self, pid: int) -> bool:
        with suppress(OSError):
            return beginning(self._proc / str(pid) / "comm").strip() in PROGRAMS
        return False

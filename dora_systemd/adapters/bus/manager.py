"""What the use cases ask of systemd; `systemd` does it in real life, a fake in unit tests."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

JOB_DONE = "done"

SETTLED = ("active", "reloading", "refreshing")
ON_THE_WAY = ("activating", "deactivating")
UP = (*SETTLED, *ON_THE_WAY)
DOWN = ("inactive", "failed")
"""Words of ActiveState=, see systemctl(1)."""

Property = tuple[str, str, Any]
"""Name, D-Bus signature and value of one unit property."""
Observer = Callable[[Mapping[str, Any]], None]
"""Is told the properties of a unit that changed while something waits."""


class UnitState(NamedTuple):
    """One unit as ListUnits gives it: the words of `systemctl list-units`."""

    unit: str
    load: str
    active: str
    sub: str


class Manager(Protocol):
    """One systemd manager. Every method raises DoraSystemdError; the jobs end with JobRemoved's
    word: done, canceled, timeout, failed, dependency, skipped."""

    def list_units(self, pattern: str) -> list[UnitState]:
        """The loaded units that match a shell pattern."""

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        """Properties of a unit; one that systemd does not know has the LoadState "not-found"."""

    def start_transient(
        self, unit: str, properties: Sequence[Property], observer: Observer | None, wait: bool
    ) -> str:
        """Make and start a unit; the result of its start job, JOB_DONE at once unless `wait`."""

    def run_jobs(
        self, method: str, units: Sequence[str], observer: Observer | None = None
    ) -> dict[str, str]:
        """StartUnit, StopUnit or RestartUnit for all units at once; the result of each job."""

    def queue_job(self, method: str, unit: str) -> str:
        """The same for one unit, without waiting; the object path of the job."""

    def kill(self, unit: str, signal: int, whom: str = "all") -> None:
        """Send `signal` to the processes of a unit: main, control or all."""

    def reset_failed(self, unit: str) -> None:
        """Forget that a unit has failed; a transient one is gone then."""

    def set_properties(self, unit: str, properties: Sequence[Property], runtime: bool) -> None:
        """Change properties of a running unit."""

    def fileno(self) -> int:
        """For poll(2): readable when properties of a unit that was started may have changed."""

    def changes(self, unit: str) -> list[Mapping[str, Any]]:
        """What has changed of a unit's properties since the last look; does not wait."""

    def hold(self, unit: str) -> None:
        """Keep systemd from forgetting the unit, until this client leaves the bus."""

    def control_group(self) -> str:
        """The manager's own cgroup, below which its units are; "" is the root."""

    def reload(self) -> None:
        """Have the files of all units read again, as `systemctl daemon-reload`."""

    def unit_path(self) -> list[str]:
        """The directories of unit files, the most important first, as `systemctl show` has it."""

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        """Link units or files as their [Install] sections say; whether they have one."""

    def disable_unit_files(self, units: Sequence[str]) -> None:
        """Remove all links to these units."""

    def version(self) -> str:
        """The systemd version, as in "257.13-1"."""

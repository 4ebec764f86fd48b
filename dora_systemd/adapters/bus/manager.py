"""The interface to systemd for the verbs: Bus in systemd.py implements it, and a fake in tests."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

JOB_DONE = "done"

SETTLED = ("active", "reloading", "refreshing")
ON_THE_WAY = ("activating", "deactivating")
UP = (*SETTLED, *ON_THE_WAY)
DOWN = ("inactive", "failed")
"""Words of ActiveState=, see systemctl(1)."""

START_JOBS = ("start", "restart")
"""Types of jobs that start a unit that is down, see systemctl(1) list-jobs."""

Property = tuple[str, str, Any]
"""Name, D-Bus signature and value of one unit property."""
Beside = Sequence[tuple[str, Sequence[Property]]]
"""Other units, by name, with their properties."""
Observer = Callable[[Mapping[str, Any]], None]
"""Called with the changed properties of a unit during a wait; {}: nothing changes for a while."""

StageObserver = Callable[[str], None]
"""Called with a new STATUS= of a unit."""


class UnitState(NamedTuple):
    """One unit as ListUnits reports it, in the terms of `systemctl list-units`."""

    unit: str
    load: str
    active: str
    sub: str
    description: str = ""
    job: str = ""  # the type of the job that is queued for it, "" if there is none

    @property
    def is_held(self) -> bool:
        """Whether systemd has its start in the queue, and waits for other units first."""
        return self.active in DOWN and self.job in START_JOBS


class Manager(Protocol):
    """One systemd manager.

    Every method raises DoraSystemdError. The result of a job is that of JobRemoved: done, canceled,
    timeout, failed, dependency, skipped.
    """

    def list_units(self, pattern: str) -> list[UnitState]:
        """The loaded units that match a glob pattern."""

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        """Properties of a unit; if systemd does not find the unit, its LoadState is "not-found"."""

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        """Create and start a unit; return the result of the job. Without `wait`, JOB_DONE at once.

        `beside`: units that are created at the same time, because this unit needs them.
        """

    def run_jobs(
        self, method: str, units: Sequence[str], observer: Observer | None = None
    ) -> dict[str, str]:
        """StartUnit, StopUnit or RestartUnit for all units in parallel; the result of each job.

        What ends a unit thaws it first, see thaw().
        """

    def queue_job(self, method: str, unit: str) -> str:
        """Queue a job for one unit without waiting; the object path of the job.

        "" if the unit is to be stopped, and systemd does not know it any more.
        """

    def kill(self, unit: str, signal: int, whom: str = "all") -> None:
        """Send `signal` to the processes of a unit: main, control or all. Thaws the unit first."""

    def thaw(self, unit: str) -> bool:
        """Thaw a frozen unit, see `systemctl freeze`; return whether the unit was frozen.

        systemd refuses to stop a frozen unit. If its main process is killed, systemd 257 starts
        ExecStopPost= in a frozen cgroup and waits for it forever: PID 1 hangs.
        """

    def reset_failed(self, unit: str) -> None:
        """Clear the failed state of a unit; systemd then unloads a transient one."""

    def close_stored(self, unit: str) -> None:
        """Close the descriptors that systemd keeps of an ended unit."""

    def set_properties(self, unit: str, properties: Sequence[Property], runtime: bool) -> None:
        """Change properties of a loaded unit; runtime: only until the next boot."""

    def fileno(self) -> int:
        """Return a descriptor for poll(2): readable when a started unit may have changed."""

    def changes(self, unit: str) -> list[Mapping[str, Any]]:
        """The properties of a unit that changed since the last call; does not wait."""

    def hold(self, unit: str) -> None:
        """Keep systemd from unloading the unit until this client disconnects."""

    def unload(self, unit: str) -> None:
        """Have systemd check again whether it can unload an ended unit."""

    def awaited(self, unit: str) -> list[str]:
        """The units whose jobs the job of this unit waits for; [] if it has none (any more)."""

    def began_us(self) -> int:
        """Return when the manager began, CLOCK_MONOTONIC µs: at boot, or at the first login."""

    def control_group(self) -> str:
        """The manager's own cgroup, which contains its units; "" is the root."""

    def reload(self) -> None:
        """Load all unit files again, like `systemctl daemon-reload`."""

    def unit_path(self) -> list[str]:
        """The directories of unit files, highest precedence first: UnitPath in `systemctl show`."""

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        """Create the links of the [Install] sections; whether there is such a section."""

    def disable_unit_files(self, units: Sequence[str]) -> None:
        """Remove all links to these units."""

    def version(self) -> str:
        """The systemd version, as in "257.13-1"."""

    def property_types(self) -> Mapping[str, str]:
        """The D-Bus signatures of all properties that services have, by name."""


def queued_job(properties: Mapping[str, Any]) -> int:
    """The id in Job=; 0 if no job is queued, or systemd has not found the unit."""
    return int((properties["Job"] or (0,))[0])


def is_at_rest(properties: Mapping[str, Any]) -> bool:
    """Return whether a unit is down and has no job queued, by ActiveState= and Job=."""
    return properties["ActiveState"] in DOWN and not queued_job(properties)


def tell_stage(on_stage: StageObserver | None, changes: Mapping[str, Any]) -> None:
    """Call `on_stage` if a unit has changed its STATUS=; with partial() an Observer."""
    if on_stage and changes.get("StatusText"):
        on_stage(changes["StatusText"])

"""Calls systemd over D-Bus; no other code than the methods of Bus does.

The interfaces are those of org.freedesktop.systemd1(5). Bus uses the low level of pystemd and
passes the signature of every argument itself, so it needs no introspection; `property_types` is for
properties that the product does not know.

Properties belong to an interface: _UNIT_PROPERTIES lists those that are read from the Unit
interface; all others are read from the interface of the unit's type. A Unit property that is
missing there gives an error of systemd's.

To wait for a job, Bus subscribes to JobRemoved before it queues the job: in the other order the
signal of a short job could arrive before the subscription, and get lost. Signals can get lost
anyway when the message bus restarts, so the wait also reads the state of the units once a second.
"""

import re
import select
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from dora_systemd.adapters.bus.connection import (
    MANAGER_OBJECT,
    RELOAD_SECONDS,
    SERVICE,
    connect,
    decoded,
    encoded,
    explained,
)
from dora_systemd.adapters.bus.manager import JOB_DONE, Beside, Observer, Property, UnitState
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope

ROOT = MANAGER_OBJECT
MANAGER = b"org.freedesktop.systemd1.Manager"
UNIT = b"org.freedesktop.systemd1.Unit"
BY_TYPE = {
    "service": b"org.freedesktop.systemd1.Service",
    "socket": b"org.freedesktop.systemd1.Socket",
    "slice": b"org.freedesktop.systemd1.Slice",
}
PROPERTIES = b"org.freedesktop.DBus.Properties"
INTROSPECTABLE = b"org.freedesktop.DBus.Introspectable"

_IDLE_SECONDS = 1.0
_ENDING = ("StopUnit", "RestartUnit")
"""The jobs that end a unit."""
_FROZEN = ("frozen", "freezing")
_BY_PARENT = ("frozen-by-parent", "freezing-by-parent")
_UNIT_PROPERTIES = frozenset(
    (
        *("ActiveState", "SubState", "LoadState", "FragmentPath", "DropInPaths", "Transient"),
        *("ActiveEnterTimestamp", "ActiveEnterTimestampMonotonic", "InactiveEnterTimestamp"),
        *("InactiveExitTimestamp", "InactiveExitTimestampMonotonic", "InvocationID", "Job"),
        *("StateChangeTimestamp", "Description", "UnitFileState", "NeedDaemonReload", "WantedBy"),
        *("RequiredBy", "Requires", "FreezerState"),
        *("StateChangeTimestampMonotonic", "StartLimitBurst", "StartLimitIntervalUSec"),
    )
)


class Bus:
    """A connection to the manager of `scope`. Manager in manager.py documents the methods.

    for_reading: the caller changes nothing. Then each answer may take READ_SECONDS, and the private
    socket of systemd takes the place of a message bus that does not answer; see connection.py.
    seconds: timeout for each answer; 0 for the usual one.
    """

    def __init__(self, scope: Scope, for_reading: bool = False, seconds: float = 0) -> None:
        self.scope = scope
        self._bus = connect(scope, for_reading, seconds)
        self._matches: dict[bytes, Callable[..., None]] = {}
        self._version = ""

    def __del__(self) -> None:
        # pystemd closes its two file descriptors only on request; the gateway opens many.
        if hasattr(self, "_bus"):
            self._bus.close()

    def list_units(self, pattern: str) -> list[UnitState]:
        rows = self._call("list units", "ListUnitsByPatterns", ("as", []), ("as", [pattern]))
        return [UnitState(row[0], row[2], row[3], row[4], row[1], row[8]) for row in rows or ()]

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        return {name: self._read_one(unit, name) for name in names}

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        self._listen(unit)
        arguments = (("s", unit), ("s", "fail"), _typed(properties), _others(beside))
        job = self._call(f"start {unit}", "StartTransientUnit", *arguments)
        return self._wait_for_jobs({job: unit}, observer)[unit] if wait else JOB_DONE

    def run_jobs(
        self, method: str, units: Sequence[str], observer: Observer | None = None
    ) -> dict[str, str]:
        queued = [(self.queue_job(method, unit), unit) for unit in units]
        jobs = {job: unit for job, unit in queued if job}
        gone = [unit for job, unit in queued if not job]
        return self._wait_for_jobs(jobs, observer) | dict.fromkeys(gone, JOB_DONE)

    def queue_job(self, method: str, unit: str) -> str:
        if method in _ENDING:
            self.thaw(unit)
        self._listen(unit)
        action = f"{method.removesuffix('Unit').lower()} {unit}"
        try:
            return str(self._call(action, method, ("s", unit), ("s", "replace")))
        except DoraSystemdError as error:
            # A unit that has ended by itself since it was chosen needs no job to stop.
            if method != "StopUnit" or error.code is not ExitCode.NOT_FOUND:
                raise
            return ""

    def kill(self, unit: str, signal: int, whom: str = "all") -> None:
        self.thaw(unit)
        self._call(f"kill {unit}", "KillUnit", ("s", unit), ("s", whom), ("i", signal))

    def thaw(self, unit: str) -> bool:
        state = self._read_one(unit, "FreezerState")
        if state in _BY_PARENT:
            hint = f"run: systemctl {self.scope.flag} thaw {self._read_one(unit, 'Slice')}"
            raise DoraSystemdError(f"cannot use {unit}: a slice that contains it is frozen", hint)
        is_frozen = state in _FROZEN
        if is_frozen:
            self._call(f"thaw {unit}", "ThawUnit", ("s", unit))
        return is_frozen

    def reset_failed(self, unit: str) -> None:
        self._call(f"reset {unit}", "ResetFailedUnit", ("s", unit))

    def close_stored(self, unit: str) -> None:
        self._call(f"clean {unit}", "CleanUnit", ("s", unit), ("as", ["fdstore"]))

    def hold(self, unit: str) -> None:
        # Before a start only, and no user knows what it is to hold a unit.
        self._call(f"start {unit}", "RefUnit", ("s", unit))

    def unload(self, unit: str) -> None:
        # systemd checks the unit when the last reference is gone.
        with suppress(DoraSystemdError):  # it is unloaded
            self._call(f"start {unit}", "RefUnit", ("s", unit))
            self._call(f"start {unit}", "UnrefUnit", ("s", unit))

    def set_properties(self, unit: str, properties: Sequence[Property], runtime: bool) -> None:
        arguments = (("s", unit), ("b", runtime), _typed(properties))
        self._call(f"change {unit}", "SetUnitProperties", *arguments)

    def changes(self, unit: str) -> list[Mapping[str, Any]]:
        self._listen(unit)
        return [body[1] for member, body in self._signals() if member == "PropertiesChanged"]

    def awaited(self, unit: str) -> list[str]:
        job = self._read_one(unit, "Job")[0]
        try:
            jobs = self._call(f"read the job of {unit}", "GetJobBefore", ("u", job)) if job else ()
        except DoraSystemdError:
            # If the job has ended meanwhile: pystemd has no name for that error.
            if self._read_one(unit, "Job")[0] == job:
                raise
            return []
        return [one[1] for one in jobs or ()]

    def began_us(self) -> int:
        return int(self._get("read when systemd began", "UserspaceTimestampMonotonic"))

    def control_group(self) -> str:
        return str(self._get("read systemd's cgroup", "ControlGroup"))

    def reload(self) -> None:
        # The timeout belongs to the connection.
        Bus(self.scope, seconds=RELOAD_SECONDS)._call("reload systemd", "Reload")

    def unit_path(self) -> list[str]:
        return list(self._get("read where units are", "UnitPath"))

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        arguments = (("as", names), ("b", False), ("b", True))
        return bool(self._call(f"enable {names[0]}", "EnableUnitFiles", *arguments)[0])

    def disable_unit_files(self, units: Sequence[str]) -> None:
        self._call(f"disable {units[0]}", "DisableUnitFiles", ("as", units), ("b", False))

    def version(self) -> str:
        self._version = self._version or str(self._get("read systemd's version", "Version"))
        return self._version

    def property_types(self) -> dict[str, str]:
        # All services have the same properties, and systemd answers for an unknown unit as well.
        action, path = "read the properties of services", _unit_path("dora.service")
        text = str(self._call(action, "Introspect", path=path, interface=INTROSPECTABLE))
        own = text.partition(f'<interface name="{BY_TYPE["service"].decode()}">')[2]
        own = own.partition("</interface>")[0]
        return dict(re.findall(r'<property name="(\w+)" type="([^"]+)"', own))

    def fileno(self) -> int:
        return int(self._bus.get_fd())

    def _read_one(self, unit: str, name: str) -> Any:
        own = BY_TYPE.get(unit.rpartition(".")[2], UNIT)
        interface = UNIT if name in _UNIT_PROPERTIES else own
        return self._get(f"read {name} of {unit}", name, _unit_path(unit), interface)

    def _get(self, action: str, name: str, path: bytes = ROOT, interface: bytes = MANAGER) -> Any:
        arguments = (("s", interface.decode()), ("s", name))
        return self._call(action, "Get", *arguments, path=path, interface=PROPERTIES)

    def _call(
        self,
        action: str,
        method: str,
        *arguments: tuple[str, Any],
        path: bytes = ROOT,
        interface: bytes = MANAGER,
    ) -> Any:
        words = [word for signature, value in arguments for word in encoded(signature, value)]
        with explained(action, self.scope):
            reply = self._bus.call_method(SERVICE, path, interface, method.encode(), words)
        return decoded(reply.body)

    def _listen(self, unit: str) -> None:
        """Subscribe to the end of jobs and to the changed properties of `unit`."""
        path = _unit_path(unit)
        if not self._matches:
            self._call("listen to systemd", "Subscribe")
            self._match(ROOT, MANAGER, b"JobRemoved")
        if path not in self._matches:
            self._match(path, PROPERTIES, b"PropertiesChanged")

    def _match(self, path: bytes, interface: bytes, member: bytes) -> None:
        # pystemd keeps a pointer to the callback without a reference, and needs another function
        # for each match: _matches keeps them alive. The callback does nothing, because process()
        # returns every message as well.
        def ignore(_message: Any, error: Any = None, userdata: Any = None) -> None:
            del error, userdata

        self._matches[path] = ignore
        with explained("listen to systemd", self.scope):
            self._bus.match_signal(None, path, interface, member, ignore)

    def _signals(self) -> Iterator[tuple[str, Any]]:
        """Member and body of the signals that have arrived; does not wait.

        process() can return no message although more are queued, so it gets a few empty tries.
        """
        empty = 0
        while empty < 3:
            with explained("hear from systemd", self.scope):
                message = self._bus.process()
                if message.is_empty():
                    empty += 1
                    continue
                member = _member(message)
                message.process_reply(False)
            yield member, decoded(message.body)

    def _wait_for_jobs(self, jobs: dict[str, str], observer: Observer | None) -> dict[str, str]:
        """Wait for jobs, and return the results by unit. jobs: object path -> unit."""
        results: dict[str, str] = {}
        while len(results) < len(jobs):
            heard = False
            for member, body in self._signals():
                heard = True
                if member == "JobRemoved" and body[1] in jobs:
                    results[jobs[body[1]]] = body[3]
                if member == "PropertiesChanged" and observer:
                    observer(body[1])
            # No signal for a second: it may be lost, so read the state of the units as well.
            if not heard and not self._sleep(_IDLE_SECONDS):
                left = [unit for unit in jobs.values() if unit not in results]
                results |= {unit: word for unit in left if (word := self._job_result(unit))}
                if observer:
                    observer({})
        return results

    def _job_result(self, unit: str) -> str:
        if self._read_one(unit, "Job")[0]:
            return ""
        active = self._read_one(unit, "ActiveState")
        return JOB_DONE if active in ("active", "inactive") else "failed"

    def _sleep(self, seconds: float) -> bool:
        poll = select.poll()
        poll.register(self.fileno(), select.POLLIN)
        return bool(poll.poll(seconds * 1000))


def _others(beside: Beside) -> tuple[str, Any]:
    return "a(sa(sv))", [(name, _typed(properties)[1]) for name, properties in beside]


def _typed(properties: Sequence[Property]) -> tuple[str, Any]:
    return "a(sv)", [(name, (signature, value)) for name, signature, value in properties]


def _unit_path(unit: str) -> bytes:
    """The object path of a unit, escaped as sd_bus_path_encode(3) does."""
    escaped = (c if c.isascii() and c.isalnum() else f"_{ord(c):02x}" for c in unit)
    return ROOT + b"/unit/" + "".join(escaped).encode()


def _member(message: Any) -> str:
    for interface, member in ((MANAGER, b"JobRemoved"), (PROPERTIES, b"PropertiesChanged")):
        if message.is_signal(interface, member):
            return member.decode()
    return ""

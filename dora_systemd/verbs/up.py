"""`doractl up`: opens the port on which systemd starts the gateway."""

import errno
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import JOB_DONE, Manager
from dora_systemd.adapters.host.addresses import port_error
from dora_systemd.adapters.host.process_table import read_processes, socket_owners
from dora_systemd.adapters.host.unit_files import put_unit_file, read_unit_file
from dora_systemd.adapters.releases.store import make_directories, store_root
from dora_systemd.decisions.gateway.place import (
    DEFAULT_PORT,
    SERVICE_UNIT,
    SOCKET_UNIT,
    port_drop_in,
)
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.unit.setup_files import gateway_files
from dora_systemd.decisions.views.diagnosis import Process
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import name_from_unit
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name
from dora_systemd.trust.sockets import listener_uids, listening_sockets
from dora_systemd.verbs.doctor import examine
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.enabled import own_directories, wanted_units
from dora_systemd.verbs.gateway import read_gateway
from dora_systemd.verbs.setup import text_of

PORT_FILE = f"{SOCKET_UNIT}.d/50-port.conf"

_NO_LISTENER = "a connection may have had it in the last minute: try again"
"""The kernel can have given the port to a client of anything; it keeps it a while, see tcp(7)."""


def check_machine(reach: Callable[[Scope], Manager], scope: Scope) -> None:
    """Raise DoraSystemdError for the first problem that `doractl doctor` finds."""
    refuse_problems(examine(reach, scope))


def refuse_problems(findings: Iterable[Finding]) -> None:
    """Raise DoraSystemdError for the first of them that is a problem."""
    for one in findings:
        if one.state is State.PROBLEM:
            is_said = one.text.startswith("cannot ")
            message = one.text if is_said else f"cannot run dataflows here: {one.topic}: {one.text}"
            raise DoraSystemdError(message, one.remedy)


def make_state(scope: Scope) -> None:
    """Create the directory of the system's releases, as an installed tmpfiles.d does.

    The gateway may only write to the directory if it exists when the gateway starts.
    """
    with suppress(OSError):  # of all that the gateway does, only a rollback needs it
        if not scope.is_user:
            make_directories(store_root().parent)


def open_port(manager: Manager, scope: Scope, port: int | None) -> int:
    """Have systemd listen on `port`, or the port of the unit; return the port.

    Raises DoraSystemdError; nothing is changed if the port is not available.
    """
    now = read_gateway(manager)
    port_file = written_files(manager, scope)[0]
    wanted = port or (None if port_file.exists() else now.port) or DEFAULT_PORT
    if not (now.is_up and now.port == wanted):
        _check_port(wanted)
    if now.is_up:
        manager.run_jobs("StopUnit", [SOCKET_UNIT])
    if _write_units(manager, scope, port):
        manager.reload()
    for unit in (SOCKET_UNIT, SERVICE_UNIT):
        with suppress(DoraSystemdError):
            manager.reset_failed(unit)
    result = manager.run_jobs("StartUnit", [SOCKET_UNIT])[SOCKET_UNIT]
    opened = read_gateway(manager).port
    if result != JOB_DONE or opened is None:
        _check_port(opened or wanted)
        raise DoraSystemdError(
            f"cannot open port {opened or wanted}: the job of {SOCKET_UNIT} ended with {result}",
            f"systemctl {scope.flag} status {SOCKET_UNIT}",
        )
    return opened


def start_boot_target(manager: Manager, scope: Scope) -> list[str]:
    """Start the dataflows of a boot if the boot has not done so; the names of those it started."""
    state = manager.read(BOOT_TARGET, ["LoadState", "ActiveState"])
    if state["LoadState"] != "loaded" or state["ActiveState"] == "active":
        return []
    running = {cell.name for cell in read_cells(manager) if cell.is_up}
    manager.run_jobs("StartUnit", [BOOT_TARGET])
    # What was enabled before dora.target was set up is linked below another target.
    wanted = wanted_units(own_directories(manager, scope)[0], BOOT_TARGET)
    names = filter(None, map(name_from_unit, wanted))
    return sorted(name for name in names if name not in running)


def written_files(manager: Manager, scope: Scope) -> list[Path]:
    """The files that `up` writes, in the directory that a reboot empties."""
    place = own_directories(manager, scope)[1]
    return [place / PORT_FILE, *(place / file.place for file in gateway_files(scope.is_user))]


def _write_units(manager: Manager, scope: Scope, port: int | None) -> bool:
    """Write or remove the files; whether anything has changed."""
    port_file, *units = written_files(manager, scope)
    texts: dict[Path, str | None] = {}
    facts = manager.read(SOCKET_UNIT, ["LoadState", "FragmentPath"])
    if facts["LoadState"] != "loaded" or Path(facts["FragmentPath"]) in units:
        files = gateway_files(scope.is_user)
        texts |= {path: text_of(file) for path, file in zip(units, files, strict=True)}
    texts[port_file] = None if port is None else port_drop_in(port)
    changed = [path for path, text in texts.items() if read_unit_file(path) != text]
    for path in changed:
        put_unit_file(path, texts[path])
    return bool(changed)


def _check_port(port: int) -> None:
    """Raise DoraSystemdError if the port is in use, with the user of it."""
    number = port_error(port)
    if number in (errno.EACCES, errno.EPERM):
        hint = "only root may open ports below 1024: doractl up --port 53291"
        raise DoraSystemdError(f"cannot open port {port}", hint, ExitCode.NO_PERMISSION)
    if number:
        holder = _holder(port)
        others = (
            f"or take another port: doractl up --port {port + 1}, "
            "or use doractl start, which needs no port at all"
        )
        hint = f"{'stop that process' if holder else _NO_LISTENER}, {others}"
        used = f"in use by {holder}" if holder else "in use, and nothing listens on it"
        raise DoraSystemdError(f"cannot open port {port}: it is {used}", hint, ExitCode.NAME_IN_USE)


def _holder(port: int) -> str:
    """The listener on a port, as far as this user may see it; "" if there is none."""
    owners = socket_owners(listening_sockets(port))
    named: Sequence[Process] = [one for one in read_processes() if one.pid in owners]
    if named:
        return str(named[-1])
    users = ", ".join(user_name(uid, nameless="the user ") for uid in sorted(listener_uids(port)))
    return f"a process of {users}" if users else ""

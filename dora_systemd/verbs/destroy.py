"""`doractl destroy`: stops everything in one scope, and reports what is left.

Every step has a timeout. Units of others are not touched, even in our slice.
"""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import DOWN, Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.host.process_table import read_processes
from dora_systemd.adapters.host.unit_files import read_unit_file, remove_empty, remove_unit_file
from dora_systemd.decisions.gateway.place import SERVICE_UNIT, SOCKET_UNIT
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import SLICE, name_from_unit
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, proven, read_cell, read_cells
from dora_systemd.verbs.facts.containers import find_outside, with_left
from dora_systemd.verbs.facts.enabled import own_directories
from dora_systemd.verbs.facts.reading import slice_group
from dora_systemd.verbs.stop import (
    KILLED_SECONDS,
    POLL_SECONDS,
    drop_disabled,
    end_links_of,
    release_enabled,
    stop_within,
)
from dora_systemd.verbs.up import written_files

_ROUNDS = 5
"""Maximum searches for dataflows that were started meanwhile."""

_GATEWAY = (SOCKET_UNIT, SERVICE_UNIT)


def running_cells(manager: Manager) -> list[Cell]:
    """The dataflows to stop."""
    return proven(cell for cell in read_cells(manager) if cell.is_up)


def stop_all(
    manager: Manager, scope: Scope, want_kill: bool, now: Callable[[], float] = time.monotonic
) -> Iterator[Outcome]:
    """Stop all dataflows in parallel; yields each as soon as it has ended.

    want_kill: kill the nodes at once. Otherwise each dataflow has the TimeoutStopSec= of its unit,
    and is killed then.
    """
    given_up: set[str] = set()
    for _ in range(_ROUNDS):
        cells = [cell for cell in running_cells(manager) if cell.unit not in given_up]
        if not cells:
            return
        outside = find_outside(manager, [cell.unit for cell in cells])
        for one in stop_within(manager, cells, 0 if want_kill else None, now):
            given_up |= {one.cell.unit} if one.problem else set()
            note = f" ({one.note})" if one.note else ""
            outcome = Outcome(one.cell, f"  ✓ {one.cell.name} stopped{note}", one.problem)
            yield from with_left([outcome], outside)
        end_links_of(manager, cells)
        release_enabled(manager, scope, [cell.unit for cell in cells])


def drop_all_disabled(manager: Manager, scope: Scope) -> None:
    """Remove the unit files of disabled dataflows, also of those that systemctl has stopped."""
    with suppress(DoraSystemdError):
        files = own_directories(manager, scope)[1].glob("dora-*.service")
        units = [path.name for path in files if name_from_unit(path.name)]
        drop_disabled(manager, scope, units)


def stop_gateway(manager: Manager, scope: Scope) -> bool:
    """Close the port and take away what `up` has written; whether it was open."""
    up = [unit for unit in _GATEWAY if _state(manager, unit) not in DOWN]
    if up:
        manager.run_jobs("StopUnit", up)
    for unit in _GATEWAY:
        if _state(manager, unit) == "failed":  # as after SIGKILL; systemd would keep it
            manager.reset_failed(unit)
    written = [path for path in written_files(manager, scope) if read_unit_file(path) is not None]
    for path in written:
        remove_unit_file(path)
        remove_empty(path.parent)
    if written:
        manager.reload()
    return bool(up)


def stop_gateway_of(manager: Manager, scope: Scope, files: Sequence[Path]) -> bool:
    """Close the port if one of `files` is its unit, before that is removed; whether it was open."""
    fragment = Path(manager.read(SOCKET_UNIT, ["FragmentPath"])["FragmentPath"])
    return fragment in files and stop_gateway(manager, scope)


def stop_slice(manager: Manager) -> list[str]:
    """Stop dora.target and dora.slice; the units of others that keep the slice active."""
    facts = manager.read(SLICE, ["LoadState", "ActiveState", "RequiredBy"])
    others = [unit for unit in facts["RequiredBy"] if _state(manager, unit) not in DOWN]
    wanted = [BOOT_TARGET, *([] if others else [SLICE])]
    active = [unit for unit in wanted if _state(manager, unit) == "active"]
    if active:
        manager.run_jobs("StopUnit", active)
    return sorted(unit for unit in others if not _is_ours(manager, unit))


def processes_left(
    manager: Manager, others: Sequence[str], now: Callable[[], float] = time.monotonic
) -> list[str]:
    """List what runs in dora.slice, as "process 12 (command)", without the units `others`.

    Kills these processes once more: with SendSIGKILL=no systemd leaves some behind.
    """
    deadline = now() + KILLED_SECONDS
    while (groups := _populated(manager, others)) and now() < deadline:
        for group in groups:
            with suppress(DoraSystemdError):
                manager.kill(group.name, signal.SIGKILL)
        time.sleep(POLL_SECONDS)
    pids = {pid for group in groups for pid in cgroup.pids(group)}
    return [str(one) for one in read_processes() if one.pid in pids]


def _populated(manager: Manager, others: Sequence[str]) -> list[Path]:
    """The cgroups of units in dora.slice that have a process."""
    return [
        path
        for path in sorted(slice_group(manager).glob("*.*"))
        if path.is_dir() and path.name not in others and cgroup.is_populated(path)
    ]


def _is_ours(manager: Manager, unit: str) -> bool:
    """Whether the unit is a dataflow of ours, and does not only have such a name."""
    return name_from_unit(unit) is not None and read_cell(manager, unit) is not None


def _state(manager: Manager, unit: str) -> str:
    active: str = manager.read(unit, ["ActiveState"])["ActiveState"]
    return active

"""Who inhibits restarts of dataflows: locks from the kernel, reasons from the lock file."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence

from dora_systemd.adapters.host.process_table import LockProcess, read_flocks, read_lock_process
from dora_systemd.decisions.cell.inhibit import parse_reasons
from dora_systemd.decisions.views.rows import DataflowRow, Holder
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import RUNTIME_NAME, Scope
from dora_systemd.trust.locks import open_lock, place_of, read_reasons
from dora_systemd.trust.paths import user_name

MOST_HOLDERS = 20
"""Maximum number of holders of a dataflow that are shown."""
_NODE = re.compile(r"/node-([^/]+)")

Flocks = Mapping[int, Sequence[int]]


def read_holders(scope: Scope, names: Iterable[str]) -> dict[str, tuple[Holder, ...]]:
    """The holders of locks by dataflow, without dataflows that nobody inhibits.

    A lock file that is not usable, or that the caller may not see, counts as none.
    """
    found = {}
    # Without any lock below /run, no directory of a dataflow needs to be opened.
    if flocks := read_cell_flocks(scope):
        for name in names:
            try:
                found[name] = holders_of(scope, name, flocks)
            except DoraSystemdError:
                continue
    return {name: holders for name, holders in found.items() if holders}


def mark_inhibited(scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The rows with who inhibits a restart."""
    found = read_holders(scope, [row.name for row in rows if row.nodes_total])
    return [row._replace(inhibitors=found.get(row.name, ())) for row in rows]


def read_cell_flocks(scope: Scope) -> Flocks:
    """All locks on the file system that has the directories of dataflows, by inode."""
    try:
        device = (scope.runtime_root / RUNTIME_NAME).stat().st_dev
    except OSError:
        return {}
    return read_flocks(device)


def holders_of(scope: Scope, name: str, flocks: Flocks) -> tuple[Holder, ...]:
    """Who holds locks of a dataflow. Raises DoraSystemdError for a lock file that is not usable."""
    lock = open_lock(scope.cell_directory(name))
    if lock is None:
        return ()
    try:
        pids = flocks.get(place_of(lock).inode, ())
        reasons = parse_reasons(read_reasons(lock)) if pids else {}
    finally:
        os.close(lock)
    few = sorted(set(pids))[:MOST_HOLDERS]
    return tuple(_holder(read_lock_process(pid), name, reasons) for pid in few)


def _holder(process: LockProcess, name: str, reasons: Mapping[int, str]) -> Holder:
    _, _, group = process.group.partition(f"/{unit_name(name)}")
    node = _NODE.match(group)
    user = "" if process.uid < 0 else user_name(process.uid)
    why = reasons.get(process.inner_pid, "")
    return Holder(process.pid, user, process.command, node[1] if node else "", why)

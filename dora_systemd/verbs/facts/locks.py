"""Who inhibits restarts of dataflows, and what every restart requests here first: no lock.

The kernel knows the locks, the lock file the reasons.
"""

import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from pathlib import Path

from dora_systemd.adapters.host.process_table import LockProcess, read_flocks, read_lock_process
from dora_systemd.decisions.views.inhibitors import format_holders, parse_reasons
from dora_systemd.decisions.views.rows import DataflowRow, Holder
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import Named, unit_name
from dora_systemd.scope import RUNTIME_NAME, Scope
from dora_systemd.trust.locks import open_lock, place_of, read_reasons, take_lock
from dora_systemd.trust.paths import user_name

MOST_HOLDERS = 20
"""Maximum number of holders of a dataflow that are shown."""
_NODE = r"/node-([^/]+)"

Flocks = Mapping[int, Sequence[int]]
_POLL_SECONDS = 0.2
Tell = Callable[[str], None]


def read_holders(scope: Scope, names: Iterable[str]) -> dict[str, tuple[Holder, ...]]:
    """Return the holders of locks by dataflow, without dataflows that no lock inhibits.

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
    """Read all locks on the file system with the directories of dataflows, by inode."""
    try:
        device = (scope.runtime_root / RUNTIME_NAME).stat().st_dev
    except OSError:
        return {}
    return read_flocks(device)


def holders_of(scope: Scope, name: str, flocks: Flocks) -> tuple[Holder, ...]:
    """Read who holds locks of a dataflow. Raises DoraSystemdError for an unusable lock file."""
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
    node = re.match(_NODE, group)
    user = "" if process.uid < 0 else user_name(process.uid)
    why = reasons.get(process.inner_pid, "")
    return Holder(process.pid, user, process.command, node[1] if node else "", why)


class IfInhibited(Enum):
    """The choice for a dataflow whose restart is inhibited."""

    REFUSE = "refuse"
    WAIT = "wait"
    FORCE = "force"


@contextmanager
def uninhibited(
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited = IfInhibited.REFUSE,
    tell: Tell | None = None,
) -> Iterator[None]:
    """Hold the locks of the dataflows exclusively, so that no new lock can inhibit them meanwhile.

    A lock file that a restart replaces is not held any more. verb: the action on the dataflows, for
    the error. `tell`: called at each check with the reason of the wait.

    Raises DoraSystemdError: INHIBITED if a lock of one of them is held, BAD_INPUT for a lock file
    that is not usable.
    """
    with ExitStack() as held:
        if how is not IfInhibited.FORCE:
            _hold(held, scope, dataflows, verb, how, tell)
        yield


def require_uninhibited(
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited = IfInhibited.REFUSE,
    tell: Tell | None = None,
) -> None:
    """Check as uninhibited() does, for an action during which nodes may take the lock."""
    with uninhibited(scope, dataflows, verb, how, tell):
        pass


def _hold(
    held: ExitStack,
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited,
    tell: Tell | None,
) -> None:
    while (one := _locked(held, scope, dataflows)) is not None:
        held.close()  # do not keep nodes of the others from their locks meanwhile
        error = _inhibited(scope, one, verb)
        if how is IfInhibited.REFUSE:
            raise error
        if tell is not None:
            tell(f"{error.message}; waiting for its end")
        time.sleep(_POLL_SECONDS)


def _locked(held: ExitStack, scope: Scope, dataflows: Sequence[Named]) -> Named | None:
    """Take all locks into `held`; the first dataflow whose lock another process holds, or None."""
    for one in dataflows:
        lock = _open(scope, one)
        if lock is None:
            continue
        held.callback(os.close, lock)
        if not _take(scope.cell_directory(one.name), lock):
            return one
    return None


def _open(scope: Scope, dataflow: Named) -> int | None:
    try:
        return open_lock(scope.cell_directory(dataflow.name))
    except DoraSystemdError as error:
        if not read_cell_flocks(scope):
            return None  # whatever the file is, no process holds a lock
        hint = "use sudo, or --force to do it in any case"
        raise DoraSystemdError(error.message, hint, error.code) from error


def _take(directory: Path, lock: int) -> bool:
    try:
        return take_lock(directory, lock, is_shared=False)
    except DoraSystemdError as error:
        hint = "whether it is inhibited is not known; --force does it anyway"
        raise DoraSystemdError(error.message, hint, error.code) from error


def _inhibited(scope: Scope, dataflow: Named, verb: str) -> DoraSystemdError:
    holders: Sequence[Holder] = ()
    with suppress(DoraSystemdError):
        holders = holders_of(scope, dataflow.name, read_cell_flocks(scope))
    # The kernel does not name a process that has passed its lock on to a child and has ended.
    who = format_holders(holders or (Holder(0),))
    message = f"cannot {verb} {dataflow.name}: inhibited by {who}"
    hint = "--wait waits until it is free, --force does it anyway; see doractl inhibit"
    return DoraSystemdError(message, hint, ExitCode.INHIBITED)

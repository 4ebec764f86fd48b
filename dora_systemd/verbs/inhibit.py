"""`doractl inhibit`: lists all locks, or holds one while a command runs or until interrupted."""

import os
import select
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.decisions.views.inhibitors import Inhibited, format_holders, format_reason
from dora_systemd.decisions.views.rows import Holder
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope
from dora_systemd.trust.locks import find_lock, open_lock, place_of, take_lock, write_reason
from dora_systemd.verbs.facts.cells import Cell, read_cells, refuse_parts, restart_due
from dora_systemd.verbs.facts.locks import holders_of, read_cell_flocks, read_holders

RENEW_SECONDS = 1.0
"""How often it looks whether the dataflow has restarted, and has a new lock file."""
_SIGNALED = 128
"""Added to the number of the signal that has ended a command, as in sh(1)."""


class Lock:
    """A shared lock of a dataflow. It is taken again when the dataflow has a new lock file."""

    def __init__(self, directory: Path, reason: str) -> None:
        self._directory, self._reason = directory, reason
        self._lock: int | None = None

    def take(self) -> bool:
        """Take the lock; False if another process holds it exclusively, or there is no file.

        Raises DoraSystemdError for a file that is not usable, or cannot be locked.
        """
        lock = open_lock(self._directory)
        if lock is None:
            return False
        with ExitStack() as refused:
            refused.callback(os.close, lock)
            if not take_lock(self._directory, lock, is_shared=True):
                return False
            refused.pop_all()
        write_reason(lock, format_reason(os.getpid(), self._reason))
        self.release()
        self._lock = lock
        return True

    def renew(self) -> None:
        """Take the lock again if the dataflow has another lock file since."""
        with suppress(DoraSystemdError):
            place = find_lock(self._directory)
            if place and (self._lock is None or place != place_of(self._lock)):
                self.take()

    def release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def take_inhibiting(scope: Scope, cell: Cell, reason: str) -> Lock:
    """Lock a running dataflow, and record that as an event. Raises DoraSystemdError."""
    refuse_parts([cell], "inhibit")  # the head checks its own lock only
    if not cell.has_begun:
        message = f"cannot inhibit {cell.name}: it is not running"
        raise DoraSystemdError(message, f"doractl start {cell.name}", ExitCode.NOT_RUNNING)
    if cell.awaits_restart:
        raise restart_due(cell, f"cannot inhibit {cell.name}")
    directory = scope.cell_directory(cell.name)
    lock = Lock(directory, reason)
    if not lock.take():
        raise _refusal(scope, cell)
    note_request("inhibited", cell.name, cell.uuid, "doractl inhibit", reason=reason)
    return lock


def hold(lock: Lock, command: Sequence[str]) -> int:
    """Hold the lock until the command ends; its exit status. Without one, until a signal comes.

    Raises DoraSystemdError if the command cannot run.
    """
    try:
        if not command:
            _wait(lock, None)
        return _run(lock, command)
    finally:
        lock.release()


def _run(lock: Lock, command: Sequence[str]) -> int:
    try:
        child = subprocess.Popen(command)
    except OSError as error:
        message = f"cannot run {command[0]}: {error.strerror}"
        raise usage_error(message, "give a program after --") from error
    with _signals_for(child):
        _wait(lock, child)
    status = child.wait()
    return status if status >= 0 else _SIGNALED - status


def _wait(lock: Lock, child: "subprocess.Popen[bytes] | None") -> None:
    """Renew the lock until the child ends, or for ever."""
    ends = [os.pidfd_open(child.pid)] if child else []
    while not select.select(ends, [], [], RENEW_SECONDS)[0]:
        lock.renew()


@contextmanager
def _signals_for(child: "subprocess.Popen[bytes]") -> Iterator[None]:
    """Leave Ctrl+C to the child, which gets it from the terminal, and pass other signals on."""
    kept = {signal.SIGINT: signal.signal(signal.SIGINT, signal.SIG_IGN)}
    for number in (signal.SIGTERM, signal.SIGHUP):
        kept[number] = signal.signal(number, lambda got, _: child.send_signal(got))
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


def _refusal(scope: Scope, cell: Cell) -> DoraSystemdError:
    holders: Sequence[Holder] = ()
    with suppress(DoraSystemdError):
        holders = holders_of(scope, cell.name, read_cell_flocks(scope))
    if holders:
        message = f"cannot inhibit {cell.name}: it is locked by {format_holders(holders)}"
        return DoraSystemdError(message, "try again when that has ended", ExitCode.INHIBITED)
    return DoraSystemdError(
        f"cannot inhibit {cell.name}: it has no lock file", "it may be starting"
    )


def inhibited_dataflows(manager: Manager, scope: Scope) -> list[Inhibited]:
    """The dataflows whose restart is inhibited, by name."""
    cells = {cell.name: cell for cell in read_cells(manager) if cell.is_up}
    found = read_holders(scope, cells)
    return [
        Inhibited(name, cells[name].uuid, cells[name].unit, holders)
        for name, holders in found.items()
    ]

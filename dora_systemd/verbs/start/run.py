"""`doractl run` and `start --attach`: a dataflow in the terminal that it was started in."""

import math
import os
import select
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from dora_systemd.adapters.bus.manager import (
    Manager,
    Property,
    StageObserver,
    is_at_rest,
    tell_stage,
)
from dora_systemd.decisions.life.refusal import setup_failure
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.verbs.facts.reason import logs_hint

HELD: Property = ("AddRef", "b", True)
"""Keeps an ended unit, and its result, for this client; for a new unit what hold() is for others.
"""

_POLL_SECONDS = 0.5
_ONE_REQUEST_SECONDS = 0.1
SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""What stops a dataflow that ends with this process."""
_CLD_EXITED = 1
_STATE = ("ActiveState", "Job", "ExecMainCode", "ExecMainStatus", "Result")


class LogSource(Protocol):
    """The source of the dataflow's lines."""

    def fileno(self) -> int:
        """Return a descriptor for poll(2): readable when there may be lines."""

    def print_new(self) -> None:
        """Print some of the lines that were received since the last call."""

    def finish(self) -> None:
        """Print the remaining lines of a unit that has ended."""


@contextmanager
def life_line() -> Iterator[int]:
    """The read end of a pipe, the runner's standard input: its end of file requests a stop.

    Only this process has the write end: however it dies, the dataflow stops.
    """
    read, write = os.pipe2(os.O_CLOEXEC)
    try:
        yield read
    finally:
        os.close(read)
        os.close(write)


def attached_properties(pipe: int) -> list[Property]:
    """The additional properties of an attached unit.

    See systemd.service(5) and org.freedesktop.systemd1(5). systemd unloads the unit even if it
    failed, but not before this client has read the result.
    """
    return [
        ("StandardInputFileDescriptor", "h", pipe),
        ("CollectMode", "s", "inactive-or-failed"),
        HELD,
        ("SuccessExitStatus", "(aiai)", ((RunnerExit.FAILED_AT_STOP,), ())),
    ]


def follow_unit(
    manager: Manager,
    unit: str,
    logs: LogSource,
    on_stage: StageObserver | None,
    signals: Sequence[signal.Signals] = SIGNALS,
    stop_after: int = INFINITY,
    on_stop: Callable[[], object] = lambda: None,
) -> int:
    """Print the logs of a started unit until it has ended; its exit status.

    The first of `signals` stops the dataflow gracefully, a later one kills it. stop_after: µs from
    now; then it is stopped gracefully as well. on_stop: called before that.
    """
    stop = _Stop(manager, unit, time.monotonic() + stop_after / SECOND, on_stop)
    with _interrupts(signals) as wakeup:
        poll = select.poll()
        for source in (manager.fileno(), logs.fileno(), wakeup):
            poll.register(source, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poll.poll(min(_POLL_SECONDS, stop.seconds_left) * 1000)}
            if wakeup in ready:
                os.read(wakeup, 64)
                stop.ask()
            elif not stop.seconds_left:
                stop.ask()
            logs.print_new()
            changed = manager.changes(unit)
            for changes in changed:
                tell_stage(on_stage, changes)
            # Many lines must not cause as many requests to systemd.
            status = None if ready and not changed else _exit_status(manager, unit)
            if status is not None:
                logs.finish()
                return status


def require_executed(scope: Scope, name: str, status: int) -> None:
    """Raise DoraSystemdError if systemd could not execute the runner, which reports nothing then.

    status: of follow_unit().
    """
    if reason := setup_failure(status):
        message = f"cannot start {name}: {reason}"
        raise DoraSystemdError(message, logs_hint(scope.flag, name, reason))


class _Stop:
    """Handles signals: the first stops the unit, the next kills it.

    due: seconds of the monotonic clock, when the unit is stopped without a signal. on_stop: called
    before the stop.
    """

    def __init__(
        self,
        manager: Manager,
        unit: str,
        due: float = math.inf,
        on_stop: Callable[[], object] = lambda: None,
    ) -> None:
        self._manager = manager
        self._unit = unit
        self._asked: float | None = None
        self._due = due
        self._on_stop = on_stop

    @property
    def seconds_left(self) -> float:
        """Seconds until the stop is due; infinite once the stop was requested."""
        return math.inf if self._asked is not None else max(self._due - time.monotonic(), 0)

    def ask(self) -> None:
        """Stop the unit after a signal or at `due`; kill it after the next signal."""
        if self._asked is None:
            self._on_stop()
            self._manager.queue_job("StopUnit", self._unit)
            self._asked = time.monotonic()
        # timeout(1) sends its signal to us and to our process group: that is one request.
        elif time.monotonic() - self._asked > _ONE_REQUEST_SECONDS:
            self._manager.kill(self._unit, signal.SIGKILL)


def _exit_status(manager: Manager, unit: str) -> int | None:
    """The exit status of a unit that has ended, or 128 + signal, as in a shell."""
    state = manager.read(unit, _STATE)
    if not is_at_rest(state):
        return None
    status: int = state["ExecMainStatus"]
    if status in (RunnerExit.NODES_FAILED, RunnerExit.FAILED_AT_STOP):
        # These exit statuses only serve systemd, to decide about a restart.
        return RunnerExit.FAILED
    if state["ExecMainCode"] != _CLD_EXITED and status:
        return 128 + status
    # A timeout, or a failure before the runner was executed: there is no exit status.
    return status or int(state["Result"] != "success")


@contextmanager
def _interrupts(signals: Sequence[signal.Signals]) -> Iterator[int]:
    """A file descriptor that receives a byte for each signal; nothing else is interrupted."""
    read, write = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    before = {number: signal.signal(number, lambda *_: None) for number in signals}
    wakeup = signal.set_wakeup_fd(write)
    try:
        yield read
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(read)
        os.close(write)

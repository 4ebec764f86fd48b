"""Restarts of the unit: whether this is its first life, the delay before this one, and the budget.

RestartSteps= of systemd.service(5) counts all restarts since the unit was started, so two failures
months apart would lengthen the delay. Therefore RestartSec= is the shortest delay without
HEAD_START, and 0 if HEAD_START is longer. The runner waits for the rest: before it does anything
else if the delay is longer than the shortest, else when it has prepared all that comes before the
nodes. The delay grows with each restart, until a quiet window resets it. systemd keeps the number
of restarts, see lives() in dora_systemd.adapters.host.fd_store.

StartLimitBurst= counts all starts, also those by hand, so it is only a backstop: the runner counts
the automatic restarts, and refuses the one that would exceed the budget.

Most imports are late: they take longer than everything before the coordinator.
"""

import contextlib
import os
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.adapters.host import fd_store
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import (
    HEAD_START,
    RestartPolicy,
    count_restarts,
    restart_of,
)
from dora_systemd.errors import DoraSystemdError, RestartsSpent
from dora_systemd.names import unit_name
from dora_systemd.paths import CellPaths, request_file
from dora_systemd.values import INFINITY, SECOND, counted, format_duration

Hold = Callable[[], Coroutine[Any, Any, None]]
"""Waits until the nodes may start."""

_ASK_SECONDS = 5.0
_MOST_SECONDS = 1.0
"""What systemd and ExecStopPost= may take between the end of a life and the next."""


def pause(options: RunnerOptions, paths: CellPaths) -> None:
    """Wait for the rest of a long delay; SIGTERM ends the process meanwhile.

    Raises OSError, and RestartsSpent if this restart exceeds the budget.
    """
    policy = restart_of(options)
    if policy.policy == "no":
        return
    if spent := find_spent(options, paths):
        raise spent
    if (restart := fd_store.lives()) > 1:
        restart = min(restart, asked("NRestarts", options.name, paths.is_of_user, restart))
        if (delay := policy.delay_before(restart)) > policy.delay:
            seconds = (delay - policy.unit_delay) / SECOND
            show(options.uuid, paths, seconds)
            time.sleep(seconds)
    fd_store.count_life(_now_us())


def report_last_life(options: RunnerOptions, environment: Mapping[str, str]) -> None:
    """Request a notice of the life that has failed before this automatic restart.

    systemd 254 starts the units of OnFailure= at each failure, and sets $FDSTORE; earlier versions
    start them only if no restart follows. The earlier life has left descriptors, see fd_store.

    After a boot the last life may have ended with the power: for the service to find out.
    """
    if (file := request_file(environment) if options.is_noticed else None) is None:
        return
    has_left = environment.get("LISTEN_FDNAMES")
    if (has_left and "FDSTORE" not in environment) or (not has_left and _is_after_boot(options)):
        with contextlib.suppress(OSError):
            file.touch(0o600)


def _is_after_boot(options: RunnerOptions) -> bool:
    if not options.has("black_box"):
        return False
    from dora_systemd.decisions.cell.black_box import is_after_boot

    return is_after_boot(options.of_dataflow("black_box"), _now_us())


def find_spent(options: RunnerOptions, paths: CellPaths) -> RestartsSpent | None:
    """Return the error of a restart that exceeds the budget of restarts, or None."""
    policy, lives = restart_of(options), fd_store.lives()
    if policy.policy == "no" or lives <= policy.max_restarts:
        return None
    lives = min(lives, asked("NRestarts", options.name, paths.is_of_user, lives))
    starts = fd_store.life_times()[-lives:] if lives else []
    _, used = count_restarts([*starts, _now_us()], policy.window)
    if used <= policy.max_restarts:
        return None
    most, window = policy.max_restarts, format_duration(policy.window)
    hint = f"doractl why {options.name} shows what has failed"
    return RestartsSpent(f"{counted(most, 'automatic restart')} within {window} did not help", hint)


def _now_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000


def held_until(options: RunnerOptions, is_user: bool, old: float | None = None) -> float:
    """Return when the rest of a short delay is over, CLOCK_MONOTONIC seconds.

    That is at most HEAD_START from when systemd began this process. A start, also after a requested
    stop, has no lives before it, and waits for nothing: 0. old: seconds since systemd began this
    process, None to read the time from the kernel.
    """
    now = time.clock_gettime(time.CLOCK_MONOTONIC)
    delay = restart_of(options).delay
    if (seconds := min(delay, HEAD_START) / SECOND - (age() if old is None else old)) <= 0:
        return 0.0
    # systemd's timers are up to 250 ms late, and the delay begins before ExecStopPost=.
    ended = asked("ActiveExitTimestampMonotonic", options.name, is_user, 0)
    since = now - ended / SECOND
    # After more than that it was another life, and the last one never became active.
    known = delay / SECOND - since if since < delay / SECOND + _MOST_SECONDS else seconds
    return now + max(min(seconds, known), 0)


async def no_hold() -> None:
    """Wait for nothing, because no delay has to pass."""


def begin_hold(options: RunnerOptions, is_user: bool) -> Hold:
    """Return what waits for held_until(), which a thread computes meanwhile."""
    if not fd_store.lives():
        return no_hold
    import asyncio

    from dora_systemd.adapters.host.process import beside

    moment = beside(partial(held_until, options, is_user))

    async def hold() -> None:
        until = await asyncio.wrap_future(moment)
        await asyncio.sleep(max(until - time.clock_gettime(time.CLOCK_MONOTONIC), 0))

    return hold


def age() -> float:
    """Return seconds since systemd began this process, which was before it set up the sandbox."""
    start = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]
    return time.clock_gettime(time.CLOCK_BOOTTIME) - int(start) / os.sysconf("SC_CLK_TCK")


def began_us() -> int:
    """Return when systemd began this process, in µs of CLOCK_REALTIME."""
    seconds = age()
    # Read last: between the two clocks a busy machine would do other things for a while.
    return time.time_ns() // 1000 - int(seconds * SECOND)


def asked(what: str, name: str, is_user: bool, otherwise: int) -> int:
    """Read a number that systemd has of the unit.

    A reset or a restart of the unit sets NRestarts to 0.
    """
    from dora_systemd.adapters.host.process import run_command

    scope = ["--user"] if is_user else []
    command = ["systemctl", *scope, "show", "--value", f"--property={what}", unit_name(name)]
    with contextlib.suppress(DoraSystemdError, ValueError):
        return int(run_command(command, _ASK_SECONDS).stdout)
    return otherwise


def show(uuid: str, paths: CellPaths, seconds: float) -> None:
    """Show the remaining delay in `systemctl status` and `list`."""
    from dora_systemd.adapters.host import files, notify
    from dora_systemd.decisions.cell.status import CellStatus

    duration = round(seconds * SECOND)
    begin_us = time.time_ns() // 1000 + duration
    text = f"restarting in {format_duration(-(-duration // SECOND) * SECOND)}"
    table = CellStatus(uuid=uuid, stage="restarting", text=text, started_us=begin_us)
    with contextlib.suppress(DoraSystemdError):  # only `list` needs the table
        files.write_atomic(paths.status, table.to_json(), 0o600)
    notify.send_status(text)


async def forget_restarts(options: RunnerOptions) -> None:
    """Reset the delay after a quiet window."""
    import asyncio

    policy = restart_of(options)
    if policy.policy != "no" and policy.window != INFINITY:
        await asyncio.sleep(policy.window / SECOND)
        fd_store.forget_lives()
        # The window of this life is over: its next restart begins another one.
        fd_store.count_life(_now_us() - policy.window)


_TICK = SECOND // os.sysconf("SC_CLK_TCK")
"""The accuracy of the start of a process."""
ASK_SECONDS = 5.0
"""Delay of the request of learn_first(), which must not slow down the start of the dataflow."""


def is_first_life(policy: RestartPolicy, name: str, is_user: bool) -> bool:
    """Whether NRestarts= of the unit is certainly 0.

    A life that ended before the runner had begun has left nothing in the descriptor store. So it
    must also be too early for a restart: systemd writes the file of a transient unit when it queues
    the start, and waits for RestartSec= after each life.
    """
    from dora_systemd.adapters.host.unit_files import written_us

    if policy.policy == "no":
        return True
    if not fd_store.is_first_life():
        return False
    return 0 <= began_us() + _TICK - written_us(_transient(name, is_user)) < policy.unit_delay


def is_transient(name: str, is_user: bool) -> bool:
    """Whether systemd has the unit from a client, and not from a file that a boot may start."""
    return _transient(name, is_user).exists()


def _transient(name: str, is_user: bool) -> Path:
    """Return the path of a transient unit's file, see UnitPath in systemd.unit(5)."""
    root = os.environ.get("XDG_RUNTIME_DIR", "") if is_user else "/run"
    return Path(root, "systemd/transient", unit_name(name))


class Life:
    """The time between two starts of the unit: the same for all its runs."""

    def __init__(
        self,
        uuid: str,
        is_first: bool = False,
        may_be_first: bool = False,
        hold: Hold = no_hold,
    ) -> None:
        self.uuid = uuid  # of the dataflow
        self.is_first = is_first  # systemd has certainly not restarted the unit
        self.may_be_first = may_be_first  # only systemd knows that
        self.hold = hold
        self.up_us = 0  # CLOCK_MONOTONIC, as ActiveEnterTimestampMonotonic=; 0 before that

    def become_up(self) -> None:
        """Record when the nodes became ready; a run after a reload changes nothing."""
        self.up_us = self.up_us or time.monotonic_ns() // 1000


def begin_life(options: RunnerOptions, is_user: bool) -> Life:
    """Return the life that begins with this process."""
    hold = begin_hold(options, is_user)
    is_first = is_first_life(restart_of(options), options.name, is_user)
    return Life(options.uuid, is_first, not is_first and fd_store.is_first_life(), hold)


async def learn_first(life: Life, name: str, is_user: bool, seconds: float = ASK_SECONDS) -> None:
    """Request NRestarts= from systemd once, if only it shows whether this life is the first.

    So it is with each unit that doractl enable has written. Without learn_first() every `list`
    would request NRestarts=, which does not change before the next life; a reset only makes
    NRestarts= 0. seconds: delay of the request.
    """
    import asyncio

    from dora_systemd.adapters.host.process import beside

    if life.may_be_first:
        await asyncio.sleep(seconds)
        # The limit of threads or processes may be reached: then `list` requests NRestarts=.
        with contextlib.suppress(OSError, RuntimeError):
            question = beside(partial(asked, "NRestarts", name, is_user, 1))
            life.is_first = await asyncio.wrap_future(question) == 0

"""Delays a restart: the delay grows with each restart, until a quiet window resets it.

RestartSteps= of systemd.service(5) counts all restarts since the unit was started, so two failures
months apart would lengthen the delay. Therefore RestartSec= is the shortest delay without
HEAD_START. The runner waits for the rest: before it does anything else if the delay is longer than
the shortest, else when it has prepared all that comes before the nodes. systemd keeps the number of
restarts, see lives() in dora_systemd.adapters.host.fd_store.

StartLimitBurst= counts all starts, also those by hand, so it is only a backstop: the runner counts
the automatic restarts, and refuses the one that would exceed the budget.
"""

import contextlib
import os
import time
from pathlib import Path

from dora_systemd.adapters.host import fd_store
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import HEAD_START, count_restarts
from dora_systemd.errors import DoraSystemdError, RestartsSpent
from dora_systemd.names import unit_name
from dora_systemd.paths import CellPaths
from dora_systemd.values import INFINITY, SECOND, format_duration

_ASK_SECONDS = 5.0
_MOST_SECONDS = 1.0
"""What systemd and ExecStopPost= may take between the end of a life and the next."""


def pause(options: RunnerOptions, paths: CellPaths) -> None:
    """Wait for the rest of a long delay; SIGTERM ends the process meanwhile.

    Raises OSError, and RestartsSpent if this restart exceeds the budget.
    """
    policy = options.restart
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


def find_spent(options: RunnerOptions, paths: CellPaths) -> RestartsSpent | None:
    """The error of a restart that exceeds the budget of automatic restarts, None for others."""
    policy, lives = options.restart, fd_store.lives()
    if policy.policy == "no" or lives <= policy.max_restarts:
        return None
    lives = min(lives, asked("NRestarts", options.name, paths.is_of_user, lives))
    starts = fd_store.life_times()[-lives:] if lives else []
    _, used = count_restarts([*starts, _now_us()], policy.window)
    if used <= policy.max_restarts:
        return None
    most, window = policy.max_restarts, format_duration(policy.window)
    count = "1 automatic restart" if most == 1 else f"{most} automatic restarts"
    hint = f"doractl why {options.name} tells what has failed"
    return RestartsSpent(f"{count} within {window} did not help", hint)


def _now_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000


def hold_back(options: RunnerOptions, paths: CellPaths, old: float | None = None) -> None:
    """Wait for the rest of a short delay: at most HEAD_START, from when systemd began this process.

    A start, also after a requested stop, has no lives before it, and waits for nothing. old:
    seconds since systemd began this process, None to ask the kernel.
    """
    if not fd_store.lives():
        return
    if (seconds := HEAD_START / SECOND - (age() if old is None else old)) > 0:
        # systemd's timers are up to 250 ms late, and the delay begins before ExecStopPost=.
        ended = asked("ActiveExitTimestampMonotonic", options.name, paths.is_of_user, 0)
        since = time.clock_gettime(time.CLOCK_MONOTONIC) - ended / SECOND
        delay = options.restart.delay / SECOND
        # After more than that it was another life, and the last one never became active.
        known = delay - since if since < delay + _MOST_SECONDS else seconds
        time.sleep(max(min(seconds, known), 0))


def age() -> float:
    """Seconds since systemd began this process, which was before it set up the sandbox."""
    start = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]
    return time.clock_gettime(time.CLOCK_BOOTTIME) - int(start) / os.sysconf("SC_CLK_TCK")


def asked(what: str, name: str, is_user: bool, otherwise: int) -> int:
    """A number that systemd has of the unit.

    A reset or a restart of the unit sets NRestarts to 0.
    """
    from dora_systemd.adapters.host import process

    scope = ["--user"] if is_user else []
    command = ["systemctl", *scope, "show", "--value", f"--property={what}", unit_name(name)]
    with contextlib.suppress(DoraSystemdError, ValueError):
        return int(process.run_command(command, _ASK_SECONDS).stdout)
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
    import asyncio  # imported late: it takes longer than everything before the coordinator

    if options.restart.policy != "no" and options.restart.window != INFINITY:
        await asyncio.sleep(options.restart.window / SECOND)
        fd_store.forget_lives()
        # The window of this life is over: its next restart begins another one.
        fd_store.count_life(_now_us() - options.restart.window)

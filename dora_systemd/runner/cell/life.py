"""What the node table tells of the life of a unit: the same for all its runs, as in systemd."""

import asyncio
import contextlib
import os
import time
from functools import partial
from pathlib import Path

from dora_systemd.adapters.host import fd_store
from dora_systemd.adapters.host.process import beside
from dora_systemd.adapters.host.unit_files import written_us
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.names import unit_name
from dora_systemd.runner.cell.pause import age, asked
from dora_systemd.values import SECOND

_TICK = SECOND // os.sysconf("SC_CLK_TCK")
"""The accuracy of the start of a process."""
ASK_SECONDS = 5.0
"""Until learn_first() asks: when most dataflows have started, which the question must not delay."""


def is_first_life(policy: RestartPolicy, name: str, is_user: bool) -> bool:
    """Whether NRestarts= of the unit is certainly 0.

    A life that ended before the runner had begun has left nothing in the descriptor store. So it
    must also be too early for a restart: systemd writes the file of a transient unit when it queues
    the start, and waits for RestartSec= after each life.
    """
    if policy.policy == "no":
        return True
    if not fd_store.is_first_life():
        return False
    began = time.time_ns() // 1000 - int(age() * SECOND)
    return 0 <= began + _TICK - written_us(_transient(name, is_user)) < policy.unit_delay


def is_transient(name: str, is_user: bool) -> bool:
    """Whether systemd has the unit from a client, and not from a file that a boot may start."""
    return _transient(name, is_user).exists()


def _transient(name: str, is_user: bool) -> Path:
    """The file of a transient unit, see UnitPath in systemd.unit(5)."""
    root = os.environ.get("XDG_RUNTIME_DIR", "") if is_user else "/run"
    return Path(root, "systemd/transient", unit_name(name))


class Life:
    """The time between two starts of the unit. uuid: of the dataflow.

    is_first: whether systemd has certainly not restarted the unit. may_be_first: whether only
    systemd knows that. up_us: CLOCK_MONOTONIC µs, as ActiveEnterTimestampMonotonic=; 0 before that.
    """

    def __init__(self, uuid: str, is_first: bool = False, may_be_first: bool = False) -> None:
        self.uuid, self.is_first, self.may_be_first, self.up_us = uuid, is_first, may_be_first, 0

    def become_up(self) -> None:
        """The nodes are ready. A run after a reload changes nothing: the unit has been up."""
        self.up_us = self.up_us or time.monotonic_ns() // 1000


def begin_life(options: RunnerOptions, is_user: bool) -> Life:
    """The life that begins with this process."""
    is_first = is_first_life(options.restart, options.name, is_user)
    return Life(options.uuid, is_first, not is_first and fd_store.is_first_life())


async def learn_first(life: Life, name: str, is_user: bool, seconds: float = ASK_SECONDS) -> None:
    """Ask systemd once whether it has restarted the unit, if that is all that is not known.

    That is so of each unit that doractl enable has written. Without it every `list` would ask: the
    number does not change before the next life, and a reset only makes it 0. seconds: to wait
    before that.
    """
    if life.may_be_first:
        await asyncio.sleep(seconds)
        # No thread or process may be left for it: then list asks.
        with contextlib.suppress(OSError, RuntimeError):
            question = beside(partial(asked, "NRestarts", name, is_user, 1))
            life.is_first = await asyncio.wrap_future(question) == 0

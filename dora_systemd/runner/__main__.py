"""The main process of a dataflow's unit: `python3 -m dora_systemd.runner`, started by systemd.

Its exit status is RunnerExit in decisions/life/runner_exit.py. This module starts the coordinator
before it imports the rest of the runner: the imports take longer than the coordinator takes to
listen.
"""

import contextlib
import gc
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.decisions.cell.options import RunnerOptions, parse_runner_argv
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths, own_directory
from dora_systemd.runner.cell.begin import (
    allow_core_dumps,
    enter_supervisor,
    leave_out_openssl,
    nodes_environment,
    start_coordinator,
)
from dora_systemd.runner.cell.restarts import pause, report_last_life

if TYPE_CHECKING:
    from dora_systemd.adapters.dora.check import DoraCheck
    from dora_systemd.runner.cell.boot import EarlyDaemon

    Begun = tuple[EarlyDaemon, DoraCheck]


def begin(argv: list[str]) -> "Begun | None":
    """Start the coordinator of the first run; its daemon and dora's checks follow in parallel.

    Returns None if that fails: run_cell() tries again and reports the error.
    """
    directory = own_directory(os.environ)
    if directory:
        with contextlib.suppress(OSError, DoraSystemdError):
            with contextlib.suppress(OSError):
                allow_core_dumps()
            options = parse_runner_argv(argv)
            unit = enter_supervisor()
            paths = CellPaths(Path(directory))
            report_last_life(options, os.environ)
            pause(options, paths)
            environment = nodes_environment(options.working_directory)
            if options.placed:
                return begin_shared(options, paths, unit, environment)
            coordinator = start_coordinator(options.dora, paths, environment)
            from dora_systemd.runner.cell.boot import Boot

            boot = Boot(coordinator, options, paths, unit, environment)
            from dora_systemd.adapters.dora.check import DoraCheck

            return boot, DoraCheck(options, environment, boot.listens)
    return None


def begin_shared(
    options: RunnerOptions, paths: CellPaths, unit: Path, environment: Mapping[str, str]
) -> "Begun":
    """Start dora as begin() does, on one of several machines. Raises OSError, DoraSystemdError."""
    boot: EarlyDaemon
    if options.machine:
        from dora_systemd.runner.machines.boot import MemberBoot

        boot = MemberBoot(options, paths, unit, environment)
    else:
        from dora_systemd.runner.machines.boot import HeadBoot

        boot = HeadBoot(options, paths, unit, environment)
    from dora_systemd.adapters.dora.check import DoraCheck

    return boot, DoraCheck(options, environment)  # machines compare the versions of their dora


def main(argv: list[str]) -> int:
    """Run the cell that `argv` describes; the exit status."""
    gc.disable()  # what is imported is no garbage, and Python would search it fifty times
    begun = begin(argv)
    leave_out_openssl()
    from dora_systemd.runner.main import run

    gc.freeze()
    gc.enable()
    return run(argv, begun)


if __name__ == "__main__":
    status = main(sys.argv[1:])
    with contextlib.suppress(OSError):  # journald may have restarted, and read it no more
        sys.stderr.flush()
    # Not sys.exit(): finalizing the interpreter takes a third of the time of a stop.
    os._exit(status)

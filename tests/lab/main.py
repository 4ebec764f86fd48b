"""The verbs of the lab."""

import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from lab import cgroup
from lab.browser import ensure_browser
from lab.cache import find_cache, remove_all
from lab.container import run_in_container
from lab.coredumps import ensure_with_coredump
from lab.definition import PLATFORMS
from lab.errors import LabError
from lab.foreign import ensure_foreign, run_in_foreign
from lab.image import ensure_tree
from lab.machine import run_in_emulator, run_in_vm
from lab.machines import run_in_machines
from lab.openarm import ensure_openarm
from lab.options import FOREIGN, Options, parse_options
from lab.process import need_root
from lab.rivals import ensure_rivals
from lab.runs import Guard, clean_dead_runs, close_run, open_run, opened_door
from lab.snapshot import ensure_snapshot
from lab.user_kernel import ensure_user_kernel

# As in docker and timeout: the lab's own failure is told apart from the command's.
LAB_FAILED = 125


def main(arguments: Sequence[str]) -> int:
    try:
        options = parse_options(arguments)
        need_root()
        prepare()
        return VERBS[options.verb](options)
    except LabError as error:
        print(error, file=sys.stderr)
        return LAB_FAILED
    except SystemExit as ended:  # argparse, and end_orderly()
        return ended.code if isinstance(ended.code, int) else LAB_FAILED


def prepare() -> None:
    cgroup.enter_namespace()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end_orderly)


def run_command(options: Options) -> int:
    layer = ENSURE[options.form](find_cache())
    run = open_run()
    with Guard():
        try:
            return RUN[options.form](run, layer, options)
        finally:
            close_run(run)


def end_orderly(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)


def build(options: Options) -> int:
    ENSURE[options.form](find_cache())
    return 0


def sweep(_options: Options) -> int:
    """Cleans up after a killed run; started by its guard."""
    with opened_door():
        clean_dead_runs()
    return 0


def clean(options: Options) -> int:
    sweep(options)
    remove_all(find_cache())
    return 0


ENSURE: dict[str, Callable[[Path], Path]] = {
    "container": ensure_tree,
    "vm": ensure_user_kernel,
    "emulator": ensure_snapshot,
    "rivals": ensure_rivals,
    "browser": ensure_browser,
    "openarm": ensure_openarm,
    "machines": ensure_tree,
    **{suite: partial(ensure_with_coredump, suite=suite) for suite in PLATFORMS},
    FOREIGN: ensure_foreign,
}
RUN = {
    "container": run_in_container,
    "vm": run_in_vm,
    "emulator": run_in_emulator,
    "rivals": run_in_container,
    "browser": run_in_container,
    "openarm": run_in_container,
    "machines": run_in_machines,
    **dict.fromkeys(PLATFORMS, run_in_container),
    FOREIGN: run_in_foreign,
}
VERBS = {
    "run": run_command,
    "shell": run_command,
    "build": build,
    "clean": clean,
    "sweep": sweep,
}

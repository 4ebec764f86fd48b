"""The main process of a dataflow's unit: `python3 -m dora_systemd.runner`, started by systemd.

Its exit status is dora_systemd.lifecycle.RunnerExit.
"""

import asyncio
import os
import signal
import sys
from functools import partial
from pathlib import Path

from dora_systemd import fdstore, notify
from dora_systemd import lifeevents as life
from dora_systemd.causes import Cause
from dora_systemd.cellpaths import CellPaths
from dora_systemd.cellstate import Cell, RunnerExit
from dora_systemd.cellview import initial_nodes
from dora_systemd.environment import node_environment
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.journal import JournalSocket
from dora_systemd.launch import has_pipes, kinds, python_of
from dora_systemd.options import RunnerOptions, parse_runner_argv
from dora_systemd.pipes import CellIdentity, LogPipes
from dora_systemd.preparation import PACKAGE, Prepared, prepare, with_changes
from dora_systemd.runnerdialogue import Dialogue
from dora_systemd.runnerengine import Engine
from dora_systemd.runnerloss import losses_of_user
from dora_systemd.runnernodes import Nodes, enter_supervisor, wait_eof
from dora_systemd.runnerpump import Pump, now_us
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.wiring import downstream_of

SAMPLE_SECONDS = 5.0
JOURNAL_SECONDS = 1.0
STOP_SECONDS = 7.0
BACKLOG_SECONDS = 60.0
"""How long journald may take for what the nodes have left to say, when nobody waits."""


def daemon_variables(prepared: Prepared, paths: CellPaths, unit: Path) -> dict[str, str]:
    """What the daemon's environment has besides the nodes'; launcher.sh takes it out again."""
    libexec = str(PACKAGE / "libexec")
    own = {"DORA_QUIET": "1", "RUST_BACKTRACE": "0"}
    added = {key: text for key, text in own.items() if key not in os.environ}
    kept = [node.id for node in prepared.dataflow.nodes if not has_pipes(node)]
    return {
        **added,
        "DORA_SYSTEMD_UNSET": " ".join(("DORA_QUIET", *added)),
        "DORA_SYSTEMD_CELL": str(paths.root),
        "DORA_SYSTEMD_GROUP": str(unit),
        "DORA_SYSTEMD_LIBEXEC": libexec,
        "DORA_SYSTEMD_DIRECTORY": prepared.plan.options.working_directory,
        "DORA_SYSTEMD_PYTHON": python_of(prepared.plan),
        "DORA_SYSTEMD_KEEP": " ".join(kept),
        "PATH": f"{libexec}:{prepared.plan.search_path}",
    }


def make_directories(paths: CellPaths) -> None:
    """The rooms of the RuntimeDirectory. Raises OSError."""
    for path in (paths.coordinator, paths.daemon, paths.work, paths.io):
        path.mkdir(mode=0o700, exist_ok=True)


async def run_cell(options: RunnerOptions, paths: CellPaths) -> RunnerExit:
    """Live the life of one cell."""
    started_us = now_us()
    loop = asyncio.get_running_loop()
    unit = enter_supervisor()
    make_directories(paths)
    environment = node_environment(os.environ)
    dora = Engine(options.dora, paths, environment)
    coordinator = dora.start_coordinator()  # it boots while we read
    journal = JournalSocket()
    identity = CellIdentity(options.name, options.uuid)
    # While systemd holds the pipes too, what is in them outlives a kill of this process.
    fdstore.forget_inherited()
    pipes = LogPipes(loop, journal, identity, fdstore.store)
    nodes = Nodes(unit, paths, pipes)
    losses = losses_of_user(journal, pipes) if paths.is_of_user else None
    try:
        pipes.write_event("dataflow-starting")
        prepared = prepare(options, environment)
        nodes.prepare(prepared.dataflow, options.log_rates, options.node_limits)
        table = initial_nodes(
            kinds(prepared.dataflow, prepared.plan), prepared.descriptor, started_us
        )
        fed = downstream_of(prepared.dataflow)
        cell = Cell(options.grace, started_us, table, downstream=fed)
        pump = Pump(cell, options.uuid, paths, nodes, pipes)
        dialogue = Dialogue(options, pump, dora, nodes, pipes)
        pump.connect(dialogue.actions(prepared.descriptor, daemon_variables(prepared, paths, unit)))
        listen(loop, options, pump, dialogue)
        if losses is not None:
            dialogue.spawn(losses.run())
        dialogue.watch(coordinator, dialogue.read_coordinator)
        try:
            return await dialogue.end
        finally:
            nodes.close()
            # The loop runs on, so the watchdog is fed; a stop has systemd's clock against it.
            await pipes.wait_empty(BACKLOG_SECONDS if not pump.cell.stop_by else STOP_SECONDS)
            if losses is not None:
                await losses.finish()
            dialogue.cancel()
    except DoraSystemdError as error:
        notify.send_status(f"failed: {error.message}")
        pipes.write_event("dataflow-failed", reason=error.message, cause=Cause.BAD_DATAFLOW)
        raise
    finally:
        dora.kill()
        pipes.close()
        journal.wait_read(JOURNAL_SECONDS)


def listen(
    loop: asyncio.AbstractEventLoop, options: RunnerOptions, pump: Pump, dialogue: Dialogue
) -> None:
    """Hear what asks the cell to stop, and do what is done from time to time."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, partial(stop, pump, number.name))
    dialogue.spawn(dialogue.take_samples(SAMPLE_SECONDS))
    if "WATCHDOG_USEC" in os.environ:
        seconds = int(os.environ["WATCHDOG_USEC"]) / 1_000_000 / 3
        dialogue.spawn(dialogue.feed_watchdog(seconds))
    if options.start_timeout != INFINITY:
        late = life.StartTimedOut(now_us(), options.start_timeout)
        loop.call_later(options.start_timeout / SECOND, pump.push, late)
    if options.attached:
        dialogue.spawn(stop_at_eof(pump))


def stop(pump: Pump, by: str) -> None:
    """Ask the cell to stop."""
    pump.push(life.StopAsked(now_us(), by))


async def stop_at_eof(pump: Pump) -> None:
    """Stop when who started the cell, attached, is gone."""
    await wait_eof(sys.stdin.fileno())
    stop(pump, "terminal")


def main(argv: list[str]) -> int:
    """Run the cell that `argv` describes; the exit status."""
    try:
        options = with_changes(parse_runner_argv(argv), os.environ)
        directory = os.environ.get("RUNTIME_DIRECTORY")
        if not directory:
            hint = "it is started by systemd: use `doractl start`"
            raise DoraSystemdError("cannot run without RUNTIME_DIRECTORY", hint, ExitCode.USAGE)
        return asyncio.run(run_cell(options, CellPaths(Path(directory))))
    except DoraSystemdError as error:
        print(f"{error.message}\n{error.hint}".strip(), file=sys.stderr)
        return RunnerExit.BAD_DATAFLOW
    except OSError as error:
        print(f"cannot run the dataflow: {error}", file=sys.stderr)
        return RunnerExit.FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

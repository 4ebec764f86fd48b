"""The life of a cell: what the main process of a dataflow's unit does, see runner/__main__.py.

run_cell() lives as long as the unit. It runs the dataflow once, and again whenever a reload
requires a new run: each run_once() has its own coordinator, daemon and pump. What outlasts a run
(pipes, groups, reloader, sockets) is in Runs.
"""

import asyncio
import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Coroutine
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.dora.check import DoraCheck
from dora_systemd.adapters.dora.control import read_coordinator
from dora_systemd.adapters.dora.preparation import Prepared, prepare, resolved
from dora_systemd.adapters.host import fd_store, notify
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.runner_socket.listener import serve
from dora_systemd.decisions.cell.launch import watchdogs_of
from dora_systemd.decisions.cell.limits import limits_of
from dora_systemd.decisions.cell.line_rates import rates_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.refusal import refusal_exit
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import settings_path
from dora_systemd.paths import CellPaths, own_directory, request_file
from dora_systemd.runner.cell.begin import (
    daemon_variables,
    enter_supervisor,
    make_lock,
    nodes_environment,
)
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.clock import Keepalive, StopClock, Ticks, watchdog_seconds
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Beside, say, words
from dora_systemd.runner.cell.machine_role import Alone, first_cell
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.cell.refusal import read_options, tell_failure
from dora_systemd.runner.cell.restarts import (
    Life,
    begin_life,
    find_spent,
    forget_restarts,
    learn_first,
)
from dora_systemd.runner.nodes.lost_entries import LossWatch, losses_of_user
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.nodes.rights import check_first
from dora_systemd.runner.reload.apply import Run, tell_started
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.settings_file import SettingsFile
from dora_systemd.runner.reload.swap import Swapper
from dora_systemd.runner.requests import NodeRequests, Recheck, end_held
from dora_systemd.values import INFINITY, SECOND

if TYPE_CHECKING:
    from dora_systemd.runner.recorder.keep import Rings

SAMPLE_SECONDS = 5.0
JOURNAL_SECONDS = 1.0
CLOSE_SECONDS = 7.0
LOSSES_SECONDS = 10.0
CANCEL_SECONDS = 0.5

Begun = tuple[EarlyDaemon, DoraCheck]
"""Dora's processes that are starting, and dora's checks that run in parallel."""


async def run_cell(
    given: RunnerOptions, paths: CellPaths, begun: Begun | None = None
) -> RunnerExit:
    """Live the life of one cell: one run of the dataflow after another.

    given: the options, with links in their paths. begun: the parts of the first run that exist
    already. Raises what prevents a run.
    """
    loop, options = asyncio.get_running_loop(), resolved(given)
    journal, clock = JournalSocket(), StopClock(options)
    # systemd holds the pipes too, so their content survives a kill of this process.
    this_life = begin_life(options, paths.is_of_user)
    spent = find_spent(options, paths)
    ring = fd_store.inherited_ring()
    fd_store.forget_inherited()
    origin = Origin(options.name, options.uuid)
    pipes = LogPipes(loop, journal, origin, fd_store.store, fd_store.forget)
    end: RunnerExit | None = None
    try:
        if spent:
            raise spent
        pipes.write_event("dataflow-starting")
        runs = Runs(given, options, paths, pipes, clock, begun, this_life)
        if ring >= 0 or options.has("record"):
            runs.keep_ring(ring)
        end = await live(runs, losses_of_user(journal, pipes) if paths.is_of_user else None)
        return end
    except DoraSystemdError as error:
        cause = Cause.RESTARTS_SPENT if error is spent else Cause.BAD_DATAFLOW
        tell_failure(pipes, error, cause)
        raise
    except Exception as error:
        broken = DoraSystemdError(f"cannot run the dataflow: {words(error)}")
        tell_failure(pipes, broken, Cause.RUNNER_BROKEN)
        raise
    finally:
        pipes.close(clock.left(JOURNAL_SECONDS if clock.by else CLOSE_SECONDS))
        journal.wait_read(clock.left(JOURNAL_SECONDS))
        is_over = clock.by or (end is RunnerExit.OK and restart_of(options).policy != "always")
        if is_over and options.has("record"):
            fd_store.forget_all(pipes.kept)
        elif options.has("record") and not fd_store.outlasts_failure():
            # Imported late: only systemd before 254 needs it.
            from dora_systemd.runner.cell.notices import hand_over_ring

            hand_over_ring(options, RunnerExit.RESTARTS_SPENT if spent else end)


class Runs:
    """What all runs of the dataflow share. Raises OSError if the unit's cgroup is not ours.

    given: the options before links were resolved. unit: cgroup directory. environment: that of the
    nodes. check: dora's, for the first run. `beside`: tasks that outlast a run. clock: that of the
    stop that ends the last run. boot: dora's processes of the first run, if they exist already.
    patience: seconds that dora's coordinator may take for an answer, None to watch nothing.
    """

    def __init__(
        self,
        given: RunnerOptions,
        options: RunnerOptions,
        paths: CellPaths,
        pipes: LogPipes,
        clock: StopClock,
        begun: Begun | None,
        this_life: Life,
    ) -> None:
        self.boot = begun[0] if begun else None
        self.unit = enter_supervisor()
        self.this_life, self.role = this_life, role_of(options, this_life, self.boot)
        options = self.role.options
        self.paths, self.pipes, self.clock = paths, pipes, clock
        for path in (paths.work, paths.io):
            path.mkdir(mode=0o700, exist_ok=True)
        make_lock(paths.lock)
        self.environment = nodes_environment(options.working_directory)
        settings = SettingsFile(settings_path(options.dataflow), paths.settings)
        self.reloader = Reloader(options, self.environment, settings, given)
        self.nodes = Nodes(self.unit, paths, pipes, watchdogs_of(self.role.own(options)))
        self.beside = Beside(asyncio.get_running_loop())
        self.check = begun[1] if begun else DoraCheck(options, self.environment)
        self.rings: Rings | None = None
        self.patience = watchdog_seconds(os.environ)
        self.ticks = Ticks(self.patience)

    def keep_ring(self, inherited: int) -> None:
        """Keep the ring of the recorder, or give back one that is not needed. inherited: or -1."""
        # Imported late: few dataflows have a recorder.
        from dora_systemd.runner.recorder.keep import Rings

        self.rings = Rings(inherited)


def role_of(options: RunnerOptions, this_life: Life, boot: EarlyDaemon | None) -> Alone:
    """Return the role of this machine in the dataflow of `options`. boot: of the first run."""
    if not options.placed:
        return Alone(options, this_life)
    if options.machine:
        from dora_systemd.runner.machines.member import Member

        return Member(options, this_life, boot)
    from dora_systemd.runner.machines.head import Head

    return Head(options, this_life, boot)


async def live(runs: Runs, losses: LossWatch | None) -> RunnerExit:
    """Run the dataflow, and again for each reload that requires a new run."""
    reach = partial(read_coordinator, runs.paths.control)
    beside = runs.beside
    beside.spawn("reload", runs.reloader.work())
    options, is_user = runs.reloader.options, runs.paths.is_of_user
    beside.spawn("forget restarts", forget_restarts(options))
    beside.spawn("count restarts", learn_first(runs.this_life, options.name, is_user))
    role = runs.role
    answer = Recheck(role, runs.environment, NodeRequests(runs.reloader, role).answer).answer
    if runs.rings is not None:
        answer = partial(runs.rings.answer, others=answer)
    socket = serve(runs.paths.socket, answer, reach, role.sessions, role.door)
    beside.spawn("serve its socket", socket)
    if runs.patience is not None:
        beside.spawn("feed the watchdog", Keepalive(runs.ticks.seconds).beat(runs.ticks))
    if losses is not None:
        beside.spawn("count what journald throws away", losses.run(runs.ticks.wait))
    try:
        last = await run_once(runs, is_again=False)
        while goes_on(runs, last):
            begin_again(runs, last)
            last = await run_once(runs, is_again=True)
        if losses is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(runs.clock.left(LOSSES_SECONDS)):
                    await losses.finish()
        return last.exit
    finally:
        runs.reloader.close()
        beside.cancel()


def begin_again(runs: Runs, last: Cell) -> None:
    """Prepare another run in this process, with files read again after the loss of a machine."""
    if runs.this_life.up_us:
        notify.send_reloading()
    runs.role.begin_again(last)
    if last.members:  # with several machines nothing is reloaded
        runs.reloader.current = None
        runs.check = DoraCheck(runs.role.options, runs.environment)


def goes_on(runs: Runs, last: Cell) -> bool:
    """Whether another run follows: after a reload, or a lost machine.

    Or it is the version before a reload that has failed.
    """
    if last.reload:
        return True
    if not last.is_trial or last.ready_us or last.stop_by:
        runs.reloader.go_back(last.failure or "it was stopped")
        return False
    return runs.reloader.go_back(last.failure)


async def run_once(runs: Runs, is_again: bool) -> Cell:
    """Run the dataflow once with its own dora; return the last cell. Raises DoraSystemdError."""
    started_us, options, reloader = now_us(), runs.reloader.options, runs.reloader
    boot = None if is_again else runs.boot
    role, own = runs.role, runs.role.own(options)
    dora = role.engine(options.dora, runs.paths, runs.environment, boot)
    try:
        coordinator = role.start_coordinator(dora)
        prepared = reloader.current or prepare_first(runs, options)
        role.prepare(runs.paths, prepared, runs.check)
        runs.nodes.prepare(role.here(prepared.dataflow), rates_of(own), limits_of(own))
        cell = replace(
            first_cell(options, prepared, started_us),
            is_again=is_again,
            is_trial=reloader.before is not None,
            notice=reloader.notice,
        )
        pump = Pump(role.cell(cell), runs.this_life, runs.paths, runs.nodes, runs.pipes)
        dialogue = role.dialogue(options, pump, dora, runs.nodes, runs.pipes)
        if cell.stops or options.machine:
            pump.on_node = role.node_stops(pump, dora, runs.nodes, dialogue).perform
        variables = daemon_variables(own, runs.paths, runs.unit, runs.environment)
        pump.connect(dialogue.actions(prepared.descriptor, variables))
        if options.is_noticed and (file := request_file(os.environ)):
            # Imported late: few dataflows have it.
            from dora_systemd.runner.cell.notices import notice_watch

            pump.on_change = notice_watch(file, runs.pipes)
        runs.pipes.mute()
        listen(runs, pump, dialogue)
        if coordinator is not None:
            dora.wait_boot()
            dialogue.watch(coordinator, dialogue.read_coordinator)
        run = Run(pump, runs.nodes, runs.pipes, Swapper(pump, dora))
        reloader.begin(run, prepared, started_us * 1000)
        runs.nodes.gates.make({*own.by_node("needs")})
        spawn_tasks(runs, run, prepared, dora, dialogue)
        runs.beside.attach(pump.push)
        try:
            await pump.end
        finally:
            reloader.end()
            runs.nodes.close()
            if not pump.cell.reload:
                # Wait without blocking the loop, so that the watchdog gets fed.
                await runs.pipes.wait_empty(runs.clock.for_journal())
            dialogue.cancel()
        return pump.cell
    finally:
        dora.kill()


def spawn_tasks(runs: Runs, run: Run, prepared: Prepared, dora: Engine, dialogue: Dialogue) -> None:
    """Start the other tasks of a run, as far as its options need them."""
    options, reloader = runs.reloader.options, runs.reloader
    own = runs.role.own(options)
    if own.has("needs"):
        from dora_systemd.runner.needs import wait_for_needs

        wait_for_needs(run, own, reloader.definition, dialogue.spawn)
    dialogue.spawn("end with the last node", end_held(run))
    dialogue.spawn("report that it has started", tell_started(run, reloader.has_started))
    if options.has("owes"):
        from dora_systemd.runner.owes.watch import watch_owes

        dialogue.spawn("watch what nodes owe", watch_owes(run, prepared, dora, dialogue))
    if runs.rings is not None:
        from dora_systemd.runner.recorder.keep import keep_recorder

        dialogue.spawn("record", keep_recorder(run, prepared, dora, runs.rings))


def prepare_first(runs: Runs, options: RunnerOptions) -> Prepared:
    """Read the dataflow for the first run. Raises DoraSystemdError if it is refused."""
    prepared = runs.check.beside(lambda: prepare(options, runs.environment))
    check_first(runs.role.own(options))
    return prepared


def listen(runs: Runs, pump: Pump, dialogue: Dialogue) -> None:
    """Connect signals, timers and standard input to the pump."""
    loop, options, clock = asyncio.get_running_loop(), runs.reloader.options, runs.clock
    dialogue.hold = runs.this_life.hold
    # A head shows what members sample.
    ticks = None if options.placed else runs.ticks
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, partial(stop, pump, clock, number.name))
    if clock.by:  # the signal came between two runs
        loop.call_soon(stop, pump, clock, clock.by)
    dialogue.spawn("take samples", dialogue.take_samples(SAMPLE_SECONDS, ticks))
    if runs.patience is not None:
        dialogue.spawn("watch dora", dialogue.watch_dora(runs.ticks, runs.patience))
    timeout = runs.role.start_timeout
    if pump.cell.is_trial:
        timeout = min(timeout, runs.reloader.patience * SECOND)
    if timeout != INFINITY:
        late = life.StartTimedOut(now_us(), timeout)
        loop.call_later(timeout / SECOND, pump.push, late)
    if options.attached:
        dialogue.spawn("watch its terminal", stop_at_eof(pump, clock))


def stop(pump: Pump, clock: StopClock, by: str) -> None:
    """Request a stop of the cell."""
    clock.begin(by)
    pump.push(life.StopAsked(now_us(), by))


async def stop_at_eof(pump: Pump, clock: StopClock) -> None:
    """Stop an attached dataflow when its terminal is gone."""
    loop, fd, is_over = asyncio.get_running_loop(), sys.stdin.fileno(), asyncio.Event()

    def read() -> None:
        with contextlib.suppress(BlockingIOError):
            if not os.read(fd, 4096):
                loop.remove_reader(fd)
                is_over.set()

    loop.add_reader(fd, read)
    await is_over.wait()
    stop(pump, clock, "terminal")


def run_loop(cell: Coroutine[Any, Any, RunnerExit]) -> RunnerExit:
    """Run like asyncio.run(), but without waiting for threads at the end."""
    loop = asyncio.new_event_loop()
    try:
        return loop.run_until_complete(cell)
    finally:
        if tasks := asyncio.all_tasks(loop):
            for task in tasks:
                task.cancel()
            loop.run_until_complete(asyncio.wait(tasks, timeout=CANCEL_SECONDS))


def run(argv: list[str], begun: Begun | None) -> int:
    """Run the cell that `argv` describes; the exit status. begun: see run_cell."""
    try:
        options = read_options(argv)
        directory = own_directory(os.environ)
        if not directory:
            hint = "it is started by systemd: use `doractl start`"
            raise usage_error("cannot run without RUNTIME_DIRECTORY", hint)
        return run_loop(run_cell(options, CellPaths(Path(directory)), begun))
    except DoraSystemdError as error:
        say(f"{error.message}\n{error.hint}".strip())
        return refusal_exit(error)
    except Exception as error:
        if not isinstance(error, OSError):
            say(traceback.format_exc())
        say(f"cannot run the dataflow: {words(error)}")
        return RunnerExit.FAILED

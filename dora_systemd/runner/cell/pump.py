"""The runner's event pump: it takes events through the table of decisions/life/.

The pump holds the Cell, the whole state of one run. push() passes an event to step(), stores the
new cell, publishes it (STATUS=, the status file that `list` reads), performs the actions of the
step, in their order, and sends READY=1 when it is due. A Do calls what connect() was given, mostly
a method of Dialogue; a Record writes a life event; a Deadline replaces the timer.

The pump relies on the event loop's thread: everything here runs in it and must not block. Actions
can push events, so push() queues them while it handles another one. Two things would break the
pump: a change of `cell` outside _step(), and an exception that gets past _guard(). The first
loses an event's effect; after the second the cell would wait for an event that never comes.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from dora_systemd.adapters.host import fd_store, files, notify
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.failures import ENGINE_TIMEOUT
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Action, Cell, Deadline, Do, NodeAction, Record, State
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import cell_status, format_status, is_up
from dora_systemd.decisions.logs.journal_events import END_EVENTS, NODE_END_EVENTS
from dora_systemd.decisions.resources.usage import CpuSample, LineCount, add_sample
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.failure import failed, say
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.values import SECOND

_ENDS = (*END_EVENTS, *NODE_END_EVENTS)


def now_us() -> int:
    """Read CLOCK_REALTIME in µs."""
    return time.time_ns() // 1000


def is_deleted(directory: Path) -> bool:
    """Whether a directory is gone: a mounted one still exists here, but with no links."""
    try:
        return directory.stat().st_nlink == 0
    except OSError:
        return True


class Pump:
    """Holds the cell, changes it by events, and publishes its state.

    this_life: the same for all runs of a life. Call connect() before the first push().
    end: resolves to the exit status, even if the action EXIT fails. amend: adds the nodes of other
    machines to the table. on_event: receives each event before the event changes the cell. on_node:
    carries out the actions of a stop that has an order.
    on_change: receives each event after its actions, with the cells before and after it.
    """

    def __init__(
        self, cell: Cell, this_life: Life, paths: CellPaths, nodes: Nodes, pipes: LogPipes
    ) -> None:
        self.cell = cell
        self._life = this_life
        self._paths = paths
        self._nodes = nodes
        self._pipes = pipes
        self._loop = asyncio.get_running_loop()
        self._actions: Mapping[Do, Callable[[], None]] = {}
        self._queue: deque[life.Event] = deque()
        self._is_busy = False
        self.end: asyncio.Future[RunnerExit] = self._loop.create_future()
        self._deadline: asyncio.TimerHandle | None = None
        self._samples: tuple[CpuSample, ...] = ()
        self._lines: Mapping[str, LineCount] = {}  # at the last sample
        self._text = ""
        self._is_ready = False
        self._is_unwritten = False
        self.on_event: Callable[[life.Event], None] = lambda _: None
        self.on_node: Callable[[NodeAction], None] = lambda _: None
        self.on_change: Callable[[life.Event, Cell, Cell], None] = lambda *_: None
        self.amend: Callable[[CellStatus], CellStatus] = lambda table: table
        self._waiting: list[tuple[Callable[[Cell], bool], asyncio.Future[None]]] = []

    def connect(self, actions: Mapping[Do, Callable[[], None]]) -> None:
        """Set what each Do does, and start the deadline of the state BOOTING."""
        self._actions = actions
        self._set_deadline(ENGINE_TIMEOUT)
        self._publish()
        self._announce()

    def push(self, event: life.Event) -> None:
        """Take one event through the table, then the events that its actions push.

        Raises nothing: an exception of an action becomes the event Failed, which ends the cell.
        """
        self._queue.append(event)
        if self._is_busy:
            return  # an action pushed it: the loop below takes it after the current event
        self._is_busy = True
        try:
            while self._queue:
                self._take(self._queue.popleft())
        finally:
            self._is_busy = False

    def _take(self, event: life.Event) -> None:
        before = self.cell
        if before.state is not State.ENDED:  # else one that always raises would do so for ever
            with self._guard("notify other machines"):
                self.on_event(event)
        actions = self._step(event)
        if self.cell is not before:
            with self._guard("show its state"):
                self._publish()
            with self._guard("notify its own tasks"):
                self._tell_waiting()
        for action in actions:
            with self._guard(_name(action)):
                self._perform(action)
        with self._guard("report that it is up"):
            self._announce()
        with self._guard("request a notice"):
            self.on_change(event, before, self.cell)
        if self.cell.state is State.ENDED and not self.end.done():
            self.end.set_result(self.cell.exit)  # the action EXIT failed

    def _step(self, event: life.Event) -> tuple[Action, ...]:
        try:
            self.cell, actions = step(self.cell, event)
            return actions
        except Exception as error:
            failure = failed(f"handle the event {type(event).__name__}", error)
        if isinstance(event, life.Failed):  # its handler failed too: end without the table
            self.cell = replace(self.cell, state=State.ENDED, exit=RunnerExit.FAILED)
        else:
            self.push(failure)
        return ()

    @contextlib.contextmanager
    def _guard(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.push(failed(what, error))

    def _perform(self, action: Action) -> None:
        match action:
            case Do():
                self._actions[action]()
            case Record():
                self._record(action)
            case Deadline():
                self._set_deadline(action.after)
            case _:
                self.on_node(action)

    def _record(self, record: Record) -> None:
        with self._guard(f"do what comes before the event {record.event}"):
            self._prepare(record)
        used = self._nodes.resources.most(record.node) if record.event in _ENDS else {}
        self._pipes.write_event(record.event, record.node or None, **{**used, **record.details})

    def _prepare(self, record: Record) -> None:
        if record.event in END_EVENTS:
            self._nodes.kill()  # so that no line of a node follows the last event
        elif record.node:
            self._nodes.drain([record.node], is_live=record.event not in NODE_END_EVENTS)
        elif record.event == "dataflow-stopping":
            if self._is_ready:
                # Else READY=1 comes at the end, which systemd 262 refuses after this.
                notify.send_stopping()
            fd_store.forget_lives()  # a restart that a person requests has no delay

    async def wait(self, is_so: Callable[[Cell], bool], seconds: float | None) -> bool:
        """Wait until `is_so` holds for the cell; False if it does not within `seconds`."""
        if is_so(self.cell):
            return True
        future: asyncio.Future[None] = self._loop.create_future()
        self._waiting.append((is_so, future))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await future
        return future.done() and not future.cancelled()  # it may be over by now

    def _tell_waiting(self) -> None:
        for is_so, future in self._waiting:
            if not future.done() and is_so(self.cell):
                future.set_result(None)
        self._waiting = [one for one in self._waiting if not one[1].done()]

    def _set_deadline(self, after: int | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None
        if after is not None:
            self._deadline = self._loop.call_later(
                after / SECOND, lambda: self.push(life.DeadlinePassed(now_us()))
            )

    def _publish(self) -> None:
        text = format_status(self.cell)
        if text != self._text:
            self._text = text
            notify.send_status(text)
        if is_up(self.cell):
            self._life.become_up()
        self._write_table()

    def _announce(self) -> None:
        # Last: a client that waited for READY=1 may read the table and the life events at once, and
        # may write an event that must follow "dataflow-started".
        if not self._is_ready and is_up(self.cell):
            self._is_ready = True
            notify.send_ready()

    def sample(self) -> bool:
        """Add a sample of the CPU time used, so that `list` can show CPU% without waiting.

        While the nodes run, also write events about CPU and memory pressure. Return whether nothing
        happens: no line since the last sample, hardly any CPU time used, and no limit to watch.
        """
        sample = self._nodes.sample(time.monotonic_ns() // 1000)
        lines, before = self._pipes.line_counts(), self._lines
        is_quiet, self._lines = False, lines
        if self.cell.state is State.RUNNING:
            for record in self._nodes.resources.look(self._samples, sample):
                self._record(record)
            is_quiet = self._nodes.resources.is_quiet and lines == before
        self._samples = add_sample(self._samples, sample)
        self._write_table()
        return is_quiet

    def refresh(self) -> None:
        """Write the table again, because the STATUS= of a node has changed."""
        self._write_table()

    def _write_table(self) -> None:
        own, lines, signs = self._life, self._pipes.line_counts(), self._nodes.signs()
        table = cell_status(self.cell, own.uuid, self._samples, lines, signs)
        table = table._replace(stop_dues=self._nodes.stop_dues)
        table = self.amend(table._replace(up_us=own.up_us, is_first=own.is_first))
        try:
            files.write_atomic(self._paths.status, table.to_json(), 0o600)
            self._is_unwritten = False
        except DoraSystemdError as error:
            # Only `list` needs the table: the present event must be handled in any case.
            self._report_unwritten(error)

    def _report_unwritten(self, error: DoraSystemdError) -> None:
        """Warn once that the table is out of date; end the cell if its directory is gone.

        The directory also has the nodes' pipes: without them dora cannot restart any node.
        """
        if not self._is_unwritten:
            self._is_unwritten = True
            say(f"<4>{error.message}")
        if is_deleted(self._paths.root):
            reason = f"its directory {self._paths.root} is gone"
            lost = life.Refused(now_us(), reason, Cause.DIRECTORY_LOST)
            self._loop.call_soon(self.push, lost)


def _name(action: Action) -> str:
    """Return the name of an action, as in "could not ..."."""
    match action:
        case Do():
            return action.value
        case Record():
            return f"write the event {action.event}"
        case Deadline():
            return "set its deadline"
        case _:
            return f"end node {action.node}"

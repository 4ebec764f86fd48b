"""Keeps one recorder among the nodes of a run, and the ring that it writes to.

The memory of a ring is a memfd that systemd keeps open; a socket hands it out.
"""

import asyncio
import contextlib
import fcntl
import hashlib
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora.preparation import PACKAGE, Prepared
from dora_systemd.adapters.dora.probe import recorder_python, total_memory
from dora_systemd.adapters.host import fd_store
from dora_systemd.adapters.runner_socket.client import Request
from dora_systemd.adapters.runner_socket.listener import Answer
from dora_systemd.decisions.cell.extra import RECORDER
from dora_systemd.decisions.cell.launch import PERL, LaunchPlan
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.owes.probe import extra_definition
from dora_systemd.decisions.recorder.record import (
    Record,
    check_memory,
    check_record,
    limit_of,
    parse_record,
    recorded_outputs,
)
from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    Header,
    format_header,
    parse_header,
    size_of,
    span_of,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.owes.extra_node import ExtraNode, FindPython, can_come
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

_SEALS = fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_SEAL
"""The nodes' user has the file, and must not change its size."""
_NS = 1000


def header_of(record: Record, outputs: Sequence[str], facts: Mapping[str, str]) -> Header:
    """The header of a ring for `outputs`. facts: for the file that is made of the ring."""
    span, is_small = span_of(record.memory), not record.outputs
    return Header(outputs, span, record.memory, record.last * _NS, is_small, facts)


def fitted_ring(inherited: int, header: Header) -> int:
    """The ring that an earlier life has left, if it has the same form; else another one.

    inherited: its descriptor, or -1. Raises OSError, and DoraSystemdError for too many outputs.
    """
    try:
        data = format_header(header)
    except ValueError as error:
        message = f"cannot record all outputs: {error}"
        raise DoraSystemdError(message, "name some in the setting record") from error
    if inherited >= 0 and _fits(inherited, header):
        os.pwrite(inherited, data, 0)  # the facts are those of this life
        return inherited
    free_ring(inherited)
    fd = os.memfd_create(fd_store.RING, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size_of(header))
    os.pwrite(fd, data, 0)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    fd_store.store_ring(fd)
    return fd


def _fits(fd: int, header: Header) -> bool:
    with contextlib.suppress(OSError, ValueError):
        found = parse_header(os.pread(fd, ALIGN, 0))
        return found._replace(facts={}, outputs=tuple(found.outputs)) == header._replace(
            facts={}, outputs=tuple(header.outputs)
        )
    return False


def free_ring(fd: int) -> None:
    """Close a ring, and have systemd close it: the memory is free. fd: or -1."""
    if fd >= 0:
        os.close(fd)
        fd_store.forget_ring()


class RingSocket:
    """Sends the descriptor of a ring to everyone who connects to `path`. Raises OSError."""

    def __init__(self, path: Path, ring: int) -> None:
        self._path, self._ring = path, ring
        path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        self._socket.bind(str(path))
        self._socket.listen(1)
        asyncio.get_running_loop().add_reader(self._socket, self._answer)

    def _answer(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._socket.accept()
            with connection:
                connection.setblocking(False)
                socket.send_fds(connection, [b"r"], [self._ring])

    def close(self) -> None:
        """Close the socket, but not the ring."""
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()
        self._path.unlink(missing_ok=True)


QUEUE = 4
"""Messages of an output that wait for the recorder: they hold the shared memory of the node, 8 MB.

On a machine with seven times more work than CPU time, 30 messages of 1 MB that wait for a recorder
with the lowest priority slow the other consumers down ten times and more, and 4 do not.
"""
_TICK = SECOND
_LONGEST_PAUSE = 8 * SECOND
"""µs in which nothing is recorded, if recorders end again and again."""
_GRACE = 5 * SECOND
"""dora's own when it restarts a node."""
_PATIENCE = 3
"""Ticks in which a recorder without inputs ends by itself."""
_WEIGHT, _LAST_WEIGHT = 10, 100
"""cpu.weight while it records, and while it ends; other groups have 100."""
_VARIABLES = {"RUST_LOG": "warn", "MALLOC_MMAP_THRESHOLD_": "262144"}
"""dora prints which messages it drops. What large messages have used is given back to the system:
glibc keeps it otherwise, 100 MB and more."""


class Rings:
    """The ring of a dataflow, which outlasts runs. fd: of the earlier life, or -1."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.record: Record | None = None
        self.changed = asyncio.Event()
        self.prepared: Prepared | None = None
        self._given: Record | None = None

    def free(self) -> None:
        """Give the memory back."""
        free_ring(self.fd)
        self.fd = -1

    def begin(self, prepared: Prepared) -> None:
        """Obey the options of a run, unless `doractl set` has changed the setting since."""
        self.prepared, given = prepared, prepared.plan.options.of_dataflow("record")
        if given != self._given:
            self._given = self.record = given

    async def answer(self, request: Request, others: Answer) -> dict[str, Any]:
        """Answer {"verb": "record", "what": text of the setting}. others: answers all else.

        Raises DoraSystemdError.
        """
        if request.get("verb") != "record":
            return await others(request)
        if (prepared := self.prepared) is None:
            raise DoraSystemdError("cannot change what is recorded: no node runs")
        record = parse_record(str(request.get("what")))
        check_record(record, prepared.plan.options, prepared.dataflow.nodes)
        if record is not None:
            check_memory(record, total_memory())
        self.record = record
        self.changed.set()
        return {"done": []}


async def keep_recorder(run: Run, prepared: Prepared, dora: Engine, rings: Rings) -> None:
    """Record what `rings` has, from the start of all nodes on."""
    rings.begin(prepared)
    await run.pump.wait(lambda cell: cell.state is State.RUNNING, None)
    while True:
        rings.changed.clear()
        try:
            await _record_until_changed(run, prepared, dora, rings)
        except (OSError, DoraSystemdError) as error:
            reason = error.message if isinstance(error, DoraSystemdError) else error.strerror
            run.pipes.write_event("outputs-unrecorded", reason=f"{reason}")
        await rings.changed.wait()


async def _record_until_changed(run: Run, prepared: Prepared, dora: Engine, rings: Rings) -> None:
    """Record until another value of the setting comes. Raises OSError and DoraSystemdError."""
    plan, record = prepared.plan, rings.record
    outputs = recorded_outputs(record, plan.options, prepared.dataflow.nodes) if record else ()
    if record is None or not outputs:
        rings.free()
        return
    rings.fd = fitted_ring(rings.fd, header_of(record, outputs, _facts(plan.options)))
    find_python = partial(asyncio.to_thread, recorder_python, plan)
    with closing(RingSocket(run.nodes.places[1].ring, rings.fd)):
        recorder = Recorder(run, dora, plan, record, outputs, find_python)
        work = asyncio.create_task(recorder.work())
        change = asyncio.create_task(rings.changed.wait())
        try:
            await asyncio.wait((work, change), return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                work.result()
            await recorder.end()
        finally:
            work.cancel()
            change.cancel()


def _facts(options: RunnerOptions) -> dict[str, str]:
    """The origin of the messages, for the file that is made of the ring."""
    facts = {"dataflow": options.name, "uuid": options.uuid, "host": socket.gethostname()}
    with suppress(OSError):
        facts["boot"] = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        facts["descriptor"] = hashlib.sha256(Path(options.dataflow).read_bytes()).hexdigest()
    return {**facts, "invocation": os.environ.get("INVOCATION_ID", "")}


class Recorder:
    """The recorder of one run. outputs: of the ring, in its order. find_python: see Probe."""

    def __init__(
        self,
        run: Run,
        dora: Engine,
        plan: LaunchPlan,
        record: Record,
        outputs: tuple[str, ...],
        find_python: FindPython,
    ) -> None:
        self._run, self._plan, self._record = run, plan, record
        self._outputs, self._find_python = outputs, find_python
        self._node = ExtraNode(run, dora, RECORDER, _LONGEST_PAUSE)
        self._idle = 0
        self._is_told = False

    async def work(self) -> None:
        """Keep a recorder running."""
        loop = asyncio.get_running_loop()
        while True:
            await self._tend(int(loop.time() * SECOND))
            await asyncio.sleep(_TICK / SECOND)

    async def end(self) -> None:
        """End the recorder, which another one replaces or nobody needs any more."""
        if self._node.is_there:
            self._limit({"cpu.weight": str(_LAST_WEIGHT)})
            await self._node.remove(_GRACE)

    async def _tend(self, now: int) -> None:
        inputs = self._inputs()
        if self._node.is_there:
            self._idle = 0 if inputs else self._idle + 1
            if self._idle > _PATIENCE:
                self._node.kill()  # the dataflow would not finish without it
            elif self._node.rest(now):
                self._is_told = False
        elif inputs and self._node.is_due(now):
            if self._node.ends_early:
                self._tell("the recorder ended again and again")
            if reason := await self._node.add(now, partial(self._define, inputs)):
                self._tell(reason)

    def _inputs(self) -> dict[str, dict[str, Any]]:
        """The outputs of nodes that run or may start again."""
        nodes = self._run.pump.cell.nodes
        return {
            f"{at}": {"source": one, "queue_size": QUEUE}
            for at, one in enumerate(self._outputs)
            if can_come(nodes.get(one.partition("/")[0]))
        }

    async def _define(self, inputs: dict[str, dict[str, Any]]) -> dict[str, Any]:
        python, node = await self._find_python(), self._node
        limit = str(limit_of(self._record, total_memory()))
        self._limit({"memory.max": limit, "memory.swap.max": "0", "cpu.weight": str(_WEIGHT)})
        script = PACKAGE / "runner" / "recorder" / "record.py"
        path = self._run.nodes.places[1].ring
        command = [python, "-u", str(script), str(path), str(PACKAGE)]
        node.count += 1
        launcher = PERL, self._plan.launcher
        return extra_definition(RECORDER, node.count, command, launcher, inputs, _VARIABLES)

    def _limit(self, limits: Mapping[str, str]) -> None:
        """Limit the group, as far as the kernel can: some containers have no controllers."""
        for file, text in limits.items():
            with suppress(OSError):
                cgroup.write_text(self._node.group / file, text)

    def _tell(self, reason: str) -> None:
        """Report that nothing is recorded, once until a recorder has run for a while."""
        if not self._is_told and self._run.pump.cell.state is State.RUNNING:
            self._is_told = True
            self._run.pipes.write_event("outputs-unrecorded", reason=reason)

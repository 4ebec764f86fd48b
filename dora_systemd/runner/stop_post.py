"""Writes the end of a dataflow to the journal if its runner could not.

ExecStopPost= of the unit runs `python3 -m dora_systemd.runner.stop_post NAME UUID`. A killed runner
leaves lines in the nodes' pipes, which systemd keeps open (adapters/host/fd_store.py), and no event
about the end. If the runner exited by itself, there is nothing to do. The exit status is always 0,
so that the unit keeps the result of the runner.
"""

import contextlib
import os
import sys
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.strain import read_oom
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.life.causes import RUNNER_KILLED, UNIT_RESULTS, Cause
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.decisions.resources.oom import Owner, largest, owner_details
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths, own_directory
from dora_systemd.values import format_rounded_size

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

    from dora_systemd.adapters.logs.pipes import LogPipes

QUIET_SECONDS = 0.1
DAEMON_SECONDS = 5.0
KILL_SECONDS = 2.0
READ_SECONDS = 1.0
KILLED_SECONDS = 0.005
ALL_SECONDS = 8.0
"""Time for all steps together. systemd allows as much as for a stop, at least STOP_MARGIN in
dora_systemd.decisions.life.stop_budget, including the start of Python."""
STREAMS = {".out": "stdout", ".err": "stderr"}


def main(argv: list[str]) -> int:
    """Kill the nodes, and write their last lines and how the dataflow has ended."""
    deadline = time.monotonic() + ALL_SECONDS
    (cause, reason), directory = killed_by(os.environ), own_directory(os.environ)
    if len(argv) != 2 or not directory:
        return 0
    if was_stopped_early(os.environ):
        write_last_words(argv[0], argv[1], Path(directory), "dataflow-stopped", {})
        return 0
    if not reason:
        return 0
    unit = unit_group()
    details = {"reason": reason, "cause": cause, **out_of_memory(unit)}
    with contextlib.suppress(OSError):
        kill_nodes(unit, KILL_SECONDS)
    left = deadline - time.monotonic()
    write_last_words(argv[0], argv[1], Path(directory), "dataflow-failed", details, seconds=left)
    return 0


def was_stopped_early(environ: Mapping[str, str]) -> bool:
    """Whether SIGTERM has ended the runner, which has no handler for it in its first moments."""
    return (environ.get("EXIT_CODE"), environ.get("SERVICE_RESULT")) == ("killed", "success")


def killed_by(environ: Mapping[str, str]) -> tuple[Cause, str]:
    """Return how the runner was killed, see EXIT_CODE in systemd.exec(5); "" for an exit."""
    result = environ.get("SERVICE_RESULT", "")
    if environ.get("EXIT_CODE", "") not in ("killed", "dumped"):
        return Cause.RUNNER_KILLED, ""
    killed = f"{RUNNER_KILLED} (SIG{environ.get('EXIT_STATUS', '')})"
    return UNIT_RESULTS.get(result, (Cause.RUNNER_KILLED, killed))


def write_last_words(
    name: str,
    uuid: str,
    directory: Path,
    event: str,
    details: Mapping[str, str],
    journal_socket: str = "",
    seconds: float = ALL_SECONDS,
) -> None:
    """Write the content of the pipes below `directory`, and the event of the end.

    details: of that event. journal_socket: another socket than journald's, for tests. seconds:
    timeout for everything.
    """
    deadline = time.monotonic() + seconds
    # Imported late: they take long, and the nodes are killed before that.
    import asyncio

    from dora_systemd.adapters.journal.note import JOURNAL_SOCKET
    from dora_systemd.adapters.journal.socket import JournalSocket
    from dora_systemd.adapters.logs.pipes import LogPipes

    paths = CellPaths(directory)
    loop = asyncio.new_event_loop()
    journal = JournalSocket(journal_socket or JOURNAL_SOCKET)
    pipes = LogPipes(loop, journal, Origin(name, uuid))
    with contextlib.suppress(OSError, ValueError, DoraSystemdError):
        status = CellStatus.from_json(paths.status.read_text())
        pipes.set_run(status.run)
        for node, state in status.nodes.items():
            pipes.set_pid(node, state.pid)
    with contextlib.suppress(OSError):
        for path in sorted(paths.io.iterdir()):
            if path.suffix in STREAMS:
                fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
                pipes.adopt(path.stem, STREAMS[path.suffix], fd)
                pipes.replay(path.stem, path)
                pipes.drain(path.stem)
        read_logs_of_dora(loop, pipes, paths.io, min(DAEMON_SECONDS, seconds / 2))
    pipes.write_event(event, **details)
    pipes.close(max(deadline - time.monotonic() - READ_SECONDS, 0.0))
    journal.wait_read(READ_SECONDS)
    journal.close()
    loop.close()


def read_logs_of_dora(
    loop: "AbstractEventLoop", pipes: "LogPipes", io: Path, seconds: float
) -> None:
    """Write what dora's log files have and the runner has not read, for at most `seconds`.

    The daemon may still run, and writes the last output of the nodes. Raises OSError.
    """
    from dora_systemd.adapters.logs.jsonl import PLACE_SUFFIX, resume_tail

    tails = {}
    for path in sorted(io.iterdir()):
        put = partial(pipes.write_fields, node=path.stem)
        # A damaged file of one node must not prevent reading the lines of the others.
        with contextlib.suppress(OSError, ValueError):
            if path.suffix == PLACE_SUFFIX and (tail := resume_tail(loop, path, put)):
                tails[path.stem] = tail
    deadline = time.monotonic() + seconds
    while sum(tail.drain() for tail in tails.values()) and time.monotonic() < deadline:
        time.sleep(QUIET_SECONDS)
    for node, tail in tails.items():
        tail.close()
        if tail.loss:
            pipes.write_event("lines-lost", node, count="Some", reason=tail.loss)


def unit_group() -> Path:
    """The cgroup directory of this unit."""
    unit = cgroup.group_path(cgroup.group_of())
    while unit.suffix != ".service" and unit != unit.parent:
        unit = unit.parent
    return unit


def out_of_memory(unit: Path) -> dict[str, str]:
    """Details of dataflow-failed if the kernel has killed the runner because of memory, else {}."""
    if not read_oom(unit / cgroup.SUPERVISOR).kills:
        return {}
    groups = cgroup.node_groups(unit)
    node, held = largest({key: cgroup.read_usage(one).memory or 0 for key, one in groups.items()})
    most = f"; the node {node} held most, {format_rounded_size(held)}" if node else ""
    details = {
        "reason": f"{RUNNER_KILLED}, out of memory{most}",
        "cause": str(Cause.OUT_OF_MEMORY),
    }
    if not read_oom(unit).refusals:
        return {**details, **owner_details(Owner.MACHINE)}
    limit = cgroup.read_usage(unit).memory_max or 0
    return {**details, **owner_details(Owner.DATAFLOW, limit)}


def kill_nodes(unit: Path, seconds: float) -> None:
    """Kill every node of this unit: with KillMode=mixed they are still running.

    A process that sleeps in the kernel does not die; after `seconds` this leaves it to systemd.
    """
    groups = list(cgroup.node_groups(unit).values())
    for group in groups:
        cgroup.kill_group(group)
    deadline = time.monotonic() + seconds
    while any(map(cgroup.is_populated, groups)) and time.monotonic() < deadline:
        time.sleep(KILLED_SECONDS)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

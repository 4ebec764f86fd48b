"""One conversation with a dora command: what is remembered while its connection is open."""

import asyncio
from collections.abc import Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.dora.control import Connection
from dora_systemd.decisions.gateway.request import Socket
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cells

Place = tuple[int, int]
"""Where in the journal a record is: CLOCK_REALTIME in µs, and its number."""

Task = Coroutine[Any, Any, None]

_MOST_TASKS = 16
"""As dora's own coordinator has it for topics; each log that is followed is a journalctl."""


@dataclass
class Talk:
    """The state of one connection; it ends with it, and nothing else has any.

    started: by UUID, when this connection has started a dataflow, CLOCK_REALTIME µs.
    places: by UUID and node, up to where its log has been sent.
    topics: by id of the subscription, the connection that they come from.
    is_over: the other side has gone.
    """

    socket: Socket
    scope: Scope
    started: dict[str, int] = field(default_factory=dict)
    places: dict[str, dict[str, Place]] = field(default_factory=dict)
    topics: dict[str, Connection] = field(default_factory=dict)
    is_over: bool = False
    _next: list[Task] = field(default_factory=list)
    _running: set["asyncio.Task[None]"] = field(default_factory=set)

    def after_reply(self, task: Task) -> None:
        """Run `task` once the request at hand has been answered, as long as there is somebody.

        Raises DoraSystemdError for one too many.
        """
        if len(self._running) >= _MOST_TASKS:
            task.close()
            raise DoraSystemdError(f"cannot follow more: at most {_MOST_TASKS} on one connection")
        self._next.append(task)

    def begin_tasks(self) -> None:
        """The request at hand has been answered."""
        for one in self._next:
            task = asyncio.ensure_future(one)
            self._running.add(task)
            task.add_done_callback(self._running.discard)
        self._next.clear()

    async def end(self) -> None:
        """The other side has gone: end all that was done for it."""
        self.is_over = True
        for one in self._next:
            one.close()
        tasks = list(self._running)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def find_by_uuid(scope: Scope, uuid: str) -> Cell:
    """The dataflow that systemd knows by this UUID. Raises DoraSystemdError (NOT_FOUND)."""
    for cell in read_cells(Bus(scope, for_reading=True)):
        if cell.uuid == uuid:
            return cell
    raise DoraSystemdError(
        f"no dataflow with the UUID {uuid}",
        "running: dora list; ended long ago, too: doractl list --all",
        ExitCode.NOT_FOUND,
    )


def find_if_loaded(scope: Scope, uuid: str) -> Cell | None:
    """The same, or None for one that systemd has forgotten."""
    with suppress(DoraSystemdError):
        return find_by_uuid(scope, uuid)
    return None


Result = str | Mapping[str, Any] | None
"""What is answered; None: the handler has answered by itself."""

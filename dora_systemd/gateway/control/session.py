"""The state of one connection of a dora command, kept while the connection is open."""

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
"""The position of a record in the journal: CLOCK_REALTIME in µs, and a sequence number."""

Task = Coroutine[Any, Any, None]

_MOST_TASKS = 16
"""The limit of dora's own coordinator for topics; here each followed log is a journalctl too."""


@dataclass
class Talk:
    """The state of one connection. No other connection shares it."""

    socket: Socket
    scope: Scope
    # When dataflows were started by this connection: CLOCK_REALTIME µs by UUID.
    started: dict[str, int] = field(default_factory=dict)
    # Up to where the log has been sent, by UUID and node.
    places: dict[str, dict[str, Place]] = field(default_factory=dict)
    # Set when all lines of a followed dataflow have been sent, by UUID.
    followed: dict[str, asyncio.Event] = field(default_factory=dict)
    # The connection that delivers a topic, by subscription id.
    topics: dict[str, Connection] = field(default_factory=dict)
    is_over: bool = False  # the client has disconnected
    _next: list[Task] = field(default_factory=list)
    _running: set["asyncio.Task[None]"] = field(default_factory=set)

    def after_reply(self, task: Task) -> None:
        """Run `task` after the reply to the current request, while the client is connected.

        Raises DoraSystemdError if it has disconnected, or there are too many tasks.
        """
        if self.is_over:
            task.close()
            raise DoraSystemdError("cannot follow: the client has disconnected")
        if len(self._running) >= _MOST_TASKS:
            task.close()
            raise DoraSystemdError(f"cannot follow more: at most {_MOST_TASKS} on one connection")
        self._next.append(task)

    def begin_tasks(self) -> None:
        """Start the tasks: the current request has been answered."""
        for one in self._next:
            task = asyncio.ensure_future(one)
            self._running.add(task)
            task.add_done_callback(self._running.discard)
        self._next.clear()

    async def end(self) -> None:
        """End all tasks of a disconnected client, and close what they use."""
        self.is_over = True
        for one in self._next:
            one.close()
        for connection in self.topics.values():
            connection.close()
        tasks = list(self._running)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def find_by_uuid(scope: Scope, uuid: str) -> Cell:
    """The dataflow with this UUID that systemd has loaded. Raises DoraSystemdError (NOT_FOUND)."""
    for cell in read_cells(Bus(scope, for_reading=True)):
        if cell.uuid == uuid and cell.has_options:
            return cell
    raise DoraSystemdError(
        f"no dataflow with the UUID {uuid}",
        "running: dora list; ended long ago, too: doractl list --all",
        ExitCode.NOT_FOUND,
    )


def find_if_loaded(scope: Scope, uuid: str) -> Cell | None:
    """The dataflow with this UUID, or None if systemd has not loaded it."""
    with suppress(DoraSystemdError):
        return find_by_uuid(scope, uuid)
    return None


Result = str | Mapping[str, Any] | None
"""The result to send; None: the handler has replied itself."""

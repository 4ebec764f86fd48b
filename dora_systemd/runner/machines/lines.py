"""One side of the connection between head and member, see decisions/machines/wire.py.

A side is silent if it has sent nothing for LEASE_SECONDS. The other side counts that time in its
own heartbeats: a process that did not run for a while must not conclude that the peer was silent.
"""

import asyncio
import contextlib
from collections.abc import Callable

from dora_systemd.adapters.runner_socket.listener import Ends
from dora_systemd.decisions.machines.wire import (
    BEAT_SECONDS,
    LEASE_SECONDS,
    MAX_LINE,
    Beat,
    Message,
    format_message,
    parse_message,
)
from dora_systemd.errors import DoraSystemdError

_LEASE = round(LEASE_SECONDS / BEAT_SECONDS)
_MOST_UNSENT = 4 * MAX_LINE
"""Bytes waiting for a side that does not read, after which the connection is ended."""
_MOST_LINES = 200
"""Received lines per heartbeat: usually three, after a gap those of a whole lease."""
_MOST_BYTES = 8 * MAX_LINE
"""Received bytes per heartbeat: reading them must not delay everything else."""

Hear = Callable[[Message], None]


class Lines:
    """One connection between head and member. on_beat: called before each own heartbeat."""

    def __init__(self, ends: Ends, on_beat: Callable[[], None] = lambda: None) -> None:
        self._reader, self._writer = ends
        self._on_beat = on_beat
        self._why = "the connection has ended"
        self.is_broken = False  # the connection has ended because of what the other side sent
        self.silent = 0  # own heartbeats since the last received line
        self._heard = self._bytes = 0

    def send(self, message: Message) -> None:
        """Send a message, unless the connection has ended."""
        if self._writer.is_closing():
            return
        self._writer.write(format_message(message))
        if self._writer.transport.get_write_buffer_size() > _MOST_UNSENT:
            self.end("the other side does not read")

    def end(self, why: str) -> None:
        """End the connection now. why: the reason, one line."""
        self._why = why
        self._writer.transport.abort()

    async def talk(self, hear: Hear) -> str:
        """Pass messages to `hear` until the connection ends; return the reason, one line."""
        beats = asyncio.create_task(self._beat())
        try:
            await self._read(hear)
        except DoraSystemdError as error:
            self._break(error.message)
        except ValueError:
            self._break("a line is too long")
        except Exception as error:
            # Else the other side would count as connected, and nobody would read its lines.
            self._break(f"what it says cannot be handled: {type(error).__name__}")
        finally:
            beats.cancel()
            self._writer.close()
        return self._why

    async def _read(self, hear: Hear) -> None:
        with contextlib.suppress(OSError):
            while line := await self._reader.readline():
                self.silent, self._heard = 0, self._heard + 1
                self._bytes += len(line)
                if self._heard > _MOST_LINES or self._bytes > _MOST_BYTES:
                    self._break("the other side says too much")
                    self.end(self._why)
                    return
                hear(parse_message(line))
                await asyncio.sleep(0)  # a queue of lines must not block other tasks

    def _break(self, why: str) -> None:
        self._why, self.is_broken = why, True

    async def _beat(self) -> None:
        while self.silent < _LEASE:
            self._on_beat()
            self.send(Beat())
            await asyncio.sleep(BEAT_SECONDS)
            self.silent, self._heard, self._bytes = self.silent + 1, 0, 0
        self.end(f"no word for {LEASE_SECONDS:g}s")

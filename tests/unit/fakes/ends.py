"""The two streams of a connection, without a socket."""

import asyncio
import json
from typing import Any, Self

from dora_systemd.adapters.runner_socket.listener import Ends
from dora_systemd.decisions.machines.wire import Message, format_message


class FakeWriter:
    """Keeps what is written. An abort is the end for the reader too. unsent: as the kernel has."""

    def __init__(self, reader: asyncio.StreamReader) -> None:
        self.reader, self.data, self.unsent = reader, b"", 0
        self.is_closed = False

    @property
    def transport(self) -> Self:
        return self

    def write(self, data: bytes) -> None:
        asyncio.get_running_loop()  # raises in a thread, where a real one would break
        self.data += data

    async def drain(self) -> None:
        pass

    def is_closing(self) -> bool:
        return self.is_closed

    def close(self) -> None:
        self.is_closed = True

    def abort(self) -> None:
        self.is_closed = True
        self.reader.feed_eof()

    def get_write_buffer_size(self) -> int:
        return self.unsent


class FakeEnds:
    """The other side says and hears. limit: bytes of a line."""

    def __init__(self, limit: int = 1000) -> None:
        self.reader = asyncio.StreamReader(limit=limit)
        self.writer = FakeWriter(self.reader)
        self.ends = Ends(self.reader, self.writer)

    def say(self, *messages: Message) -> None:
        for one in messages:
            self.reader.feed_data(format_message(one))

    def heard(self, without: str = "beat") -> list[dict[str, Any]]:
        """What the other side has got."""
        lines = [json.loads(line) for line in self.writer.data.splitlines()]
        return [one for one in lines if one.get("type") != without]

"""The other side of a WebSocket of the gateway, which has said all that it says."""

import json
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from typing import Any


class FakeSocket:
    """A dora command that sends these frames and goes."""

    def __init__(self, frames: Iterable[str | bytes]) -> None:
        self.frames = list(frames)
        self.sent: list[Any] = []

    async def recv(self) -> str | bytes:
        return self.frames.pop(0)

    async def send(self, message: str | bytes | AsyncIterable[str]) -> None:
        if not isinstance(message, str | bytes):
            message = "".join([part async for part in message])
        self.sent.append(json.loads(message))

    async def close(self, code: int = 1000, reason: str = "") -> None:
        del code, reason

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        while self.frames:
            yield await self.recv()

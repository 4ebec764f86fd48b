"""What the gateway's routes are given and what they give back."""

from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from dora_systemd.scope import Scope
from dora_systemd.terminal_text import escaped

PLAIN = "text/plain; charset=utf-8"


@dataclass(frozen=True)
class Request:
    """A request of somebody who may ask.

    path: without the query. headers: by name in lower case, the last value of each.
    scope: whose dataflows the gateway is for.
    """

    path: str
    scope: Scope
    query: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """An HTTP response. headers: those beside Content-Type and Content-Length."""

    status: int
    content_type: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


class Socket(Protocol):
    """A WebSocket connection, as the server of websockets has it.

    A route may let its ConnectionClosed pass: the other side has gone.
    """

    async def recv(self) -> str | bytes:
        """The next message."""

    async def send(self, message: str | bytes | AsyncIterable[str]) -> None:
        """Send a message, whole or in parts; waits while the other side is slow."""

    async def close(self, code: int = 1000, reason: str = "") -> None:
        """Say goodbye."""

    def __aiter__(self) -> AsyncIterator[str | bytes]:
        """The messages until the other side closes."""


Get = Callable[[Request], Awaitable[Answer]]
Talk = Callable[[Socket, Request], Awaitable[None]]


def text_answer(status: int, text: str, **headers: str) -> Answer:
    """An answer of one line, which curl may well write to a terminal."""
    return Answer(status, PLAIN, f"{escaped(text)}\n".encode(), headers)

"""Requests to, and answers from, the gateway's routes."""

from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from dora_systemd.scope import Scope
from dora_systemd.terminal_text import escaped

PLAIN = "text/plain; charset=utf-8"


@dataclass(frozen=True)
class Request:
    """A request with access granted.

    path: without the query. scope: that of the gateway's dataflows.
    """

    path: str
    scope: Scope


@dataclass(frozen=True)
class Answer:
    """An HTTP response. headers: in addition to Content-Type and Content-Length."""

    status: int
    content_type: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


class Socket(Protocol):
    """A WebSocket connection. A route need not catch its Gone: the other end has disconnected."""

    async def send(self, message: str | bytes | AsyncIterable[str]) -> None:
        """Send a message, whole or in parts; waits while the receiver is slow."""

    async def close(self, code: int = 1000, reason: str = "") -> None:
        """Send a closing frame."""

    def __aiter__(self) -> AsyncIterator[str | bytes]:
        """The messages, until the other end closes."""


Get = Callable[[Request], Awaitable[Answer]]
Talk = Callable[[Socket, Request], Awaitable[None]]


def text_answer(status: int, text: str, **headers: str) -> Answer:
    """An answer of one line; curl may print it to a terminal."""
    return Answer(status, PLAIN, f"{escaped(text)}\n".encode(), headers)

"""Requests to the gateway's routes, their answers, and who may send requests. Pure.

Every user of the machine, and every page in a browser on it, can connect to loopback. So a
connection alone grants nothing. The Origin: header shows a request of a browser's page, and the
Host: header shows a foreign name that resolves to this machine. All other facts are the kernel's.
"""

import hmac
import re
from collections import Counter
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from dora_systemd.scope import Scope
from dora_systemd.terminal_text import escaped

PLAIN = "text/plain; charset=utf-8"


@dataclass(frozen=True)
class Request:
    """A request with access granted."""

    path: str  # without the query
    scope: Scope  # that of the gateway's dataflows


@dataclass(frozen=True)
class Answer:
    """An HTTP response."""

    status: int
    content_type: str
    body: bytes
    # in addition to Content-Type and Content-Length
    headers: Mapping[str, str] = field(default_factory=dict)
    # reads the next part of what follows the body, b"" after the last one; rest_size: its bytes
    rest: Callable[[], bytes] | None = None
    rest_size: int = 0


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


MAX_CONNECTIONS = 256
"""Maximum connections of root and of the gateway's own user; as in dora's coordinator."""
MAX_STRANGERS = 32
"""Maximum connections of all other users together."""
MAX_OF_STRANGER = 16
"""Maximum connections of one other user."""
STRANGER_SECONDS = 2.0
"""Timeout for the headers of another user's request."""

_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_BEARER = "bearer "


class Door:
    """Counts connections, and always keeps room for root and for the gateway's owner.

    uid: the user at the other end of a connection, None if the kernel does not know.
    """

    def __init__(self, own_uid: int) -> None:
        self._known = frozenset({0, own_uid})
        self._inside: Counter[int | None] = Counter()

    def is_stranger(self, uid: int | None) -> bool:
        """Whether it is neither root nor the gateway's own user."""
        return uid not in self._known

    def enter(self, uid: int | None) -> bool:
        """Count a connection if there is room for it; whether there is."""
        is_stranger = self.is_stranger(uid)
        of_all = sum(n for one, n in self._inside.items() if self.is_stranger(one) == is_stranger)
        has_room = of_all < (MAX_STRANGERS if is_stranger else MAX_CONNECTIONS)
        if is_stranger:
            has_room = has_room and self._inside[uid] < MAX_OF_STRANGER
        self._inside[uid] += has_room
        return has_room

    def leave(self, uid: int | None) -> None:
        """Count the end of a connection that was let in."""
        self._inside -= Counter([uid])


def refuse_address(hosts: Sequence[str], origins: Sequence[str] = ()) -> Answer | None:
    """Refuse pages of other sites: the request must use one of this machine's own names.

    hosts, origins: all values of these headers, because they may be repeated. The port may differ,
    as in a tunnel (ssh -L 8080:127.0.0.1:53290). The origin of a page must be exactly the address
    that it was loaded from.
    """
    if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
        return text_answer(403, "the gateway answers to 127.0.0.1 and localhost only")
    own = f"http://{hosts[0]}".lower()
    if any(origin.lower() != own for origin in origins):
        return text_answer(403, "pages of other origins may not use the gateway")
    return None


def refuse_user(uid: int | None, own_uid: int) -> Answer | None:
    """Let in root and the gateway's own user, if no token lets the caller in.

    uid: the user at the other end of the connection, None if the kernel does not know.
    """
    if uid in (0, own_uid):
        return None
    text = "only root, its own user and holders of its token may use this gateway"
    return text_answer(401, text, **{"WWW-Authenticate": "Bearer"})


def has_token(authorizations: Sequence[str], token: str) -> bool:
    """Whether the only value of this header is this token, compared in constant time."""
    if len(authorizations) != 1 or not token:
        return False
    scheme, given = authorizations[0][: len(_BEARER)], authorizations[0][len(_BEARER) :]
    return scheme.lower() == _BEARER and hmac.compare_digest(
        given.strip().encode("utf-8", "replace"), token.encode()
    )

"""Who may ask the gateway: pure, the facts come from the kernel and from the request.

Loopback is no permission: every user of the machine can connect, and every page in a browser on it.
A browser gives itself away by Origin:, and a name that was bent to this machine by Host:.
"""

import hmac
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

MAX_CONNECTIONS = 256
"""Of root and of the gateway's own user; dora's own limit for its coordinator."""
MAX_STRANGERS = 32
"""Connections of all others together: they are refused, or have a token."""
MAX_OF_STRANGER = 16
"""Connections of one of them."""
STRANGER_SECONDS = 2.0
"""For the headers of a stranger's request to arrive."""

_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_BEARER = "bearer "


@dataclass(frozen=True)
class Caller:
    """What is known of a request. The headers have all their values, as they may come repeatedly.

    uid: whose the other end of the connection is, None where the kernel does not tell.
    """

    uid: int | None
    hosts: Sequence[str] = ()
    origins: Sequence[str] = ()
    authorizations: Sequence[str] = ()


@dataclass(frozen=True)
class Refusal:
    """An HTTP status and one line about it."""

    status: int
    text: str


class Door:
    """Counts who is in. Whatever others do, there is room for root and for the gateway's owner.

    uid: of the other end of a connection, None where the kernel does not tell.
    """

    def __init__(self, own_uid: int) -> None:
        self._known = frozenset({0, own_uid})
        self._inside: Counter[int | None] = Counter()

    def is_stranger(self, uid: int | None) -> bool:
        """Whether it is neither root nor the user whose gateway this is."""
        return uid not in self._known

    def enter(self, uid: int | None) -> bool:
        """Let a connection in, if there is room for it."""
        of_all = sum(n for one, n in self._inside.items() if self._is_like(one, uid))
        has_room = of_all < (MAX_STRANGERS if self.is_stranger(uid) else MAX_CONNECTIONS)
        if self.is_stranger(uid):
            has_room = has_room and self._inside[uid] < MAX_OF_STRANGER
        self._inside[uid] += has_room
        return has_room

    def _is_like(self, one: int | None, other: int | None) -> bool:
        return self.is_stranger(one) == self.is_stranger(other)

    def leave(self, uid: int | None) -> None:
        """A connection that was let in has ended."""
        self._inside[uid] -= 1
        if not self._inside[uid]:
            del self._inside[uid]


def refuse_address(caller: Caller) -> Refusal | None:
    """Keep out other sites' pages: the way here must be this machine's own name.

    The port may be another one, as a tunnel has it (ssh -L 8080:127.0.0.1:53290); a page's origin
    must be exactly what it was called by.
    """
    if len(caller.hosts) != 1 or not _HOST.fullmatch(caller.hosts[0]):
        return Refusal(403, "the gateway answers to 127.0.0.1 and localhost only")
    own = f"http://{caller.hosts[0]}".lower()
    if any(origin.lower() != own for origin in caller.origins):
        return Refusal(403, "pages of other origins may not use the gateway")
    return None


def refuse_user(caller: Caller, own_uid: int, token: str) -> Refusal | None:
    """Let in root, the user whose gateway this is, and whoever has the token."""
    if caller.uid in (0, own_uid) or has_token(caller, token):
        return None
    return Refusal(401, "only root, its own user and holders of its token may use this gateway")


def has_token(caller: Caller, token: str) -> bool:
    """Whether the request has this token, compared in constant time."""
    if len(caller.authorizations) != 1 or not token:
        return False
    scheme, given = caller.authorizations[0][: len(_BEARER)], caller.authorizations[0][7:]
    return scheme.lower() == _BEARER and hmac.compare_digest(
        given.strip().encode("utf-8", "replace"), token.encode()
    )

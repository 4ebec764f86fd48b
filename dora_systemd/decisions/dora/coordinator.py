"""Where the coordinator of a cell listens, as the runner notes it and tells it; pure."""

import re
from dataclasses import asdict, dataclass
from typing import Any

_TOKEN = re.compile(r"[0-9A-Za-z._~+/=-]{1,512}")
"""What a header of HTTP can have: RFC 6750, section 2.1."""


@dataclass(frozen=True)
class Coordinator:
    """Ports of 127.0.0.1 and a token.

    port: the coordinator's; token: what it asks for. local_listen_port: the daemon's for dynamic
    nodes; None where those cannot reach it.
    """

    port: int
    token: str
    local_listen_port: int | None

    def raw(self) -> dict[str, Any]:
        """For JSON; parse_coordinator reads it."""
        return asdict(self)


def parse_coordinator(raw: object) -> Coordinator:
    """The coordinator that was told of. Raises ValueError for what can be none."""
    if not isinstance(raw, dict):
        raise ValueError("not an object")
    port, listen = (_port(raw.get(key)) for key in ("port", "local_listen_port"))
    return Coordinator(port, parse_token(raw.get("token")), listen)


def parse_token(raw: object) -> str:
    """The token of a coordinator. Raises ValueError for what can be none."""
    if not isinstance(raw, str) or not _TOKEN.fullmatch(raw):
        raise ValueError("not a token")
    return raw


def _port(raw: object) -> int:
    if type(raw) is not int or not 0 < raw < 65536:
        raise ValueError("not a port")
    return raw

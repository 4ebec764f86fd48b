"""The address and token of a cell's coordinator, as the runner writes and reports them. Pure."""

import re
from dataclasses import asdict, dataclass
from typing import Any

_TOKEN = re.compile(r"[0-9A-Za-z._~+/=-]{1,512}")
"""The characters of a token in an HTTP header: RFC 6750, section 2.1."""


@dataclass(frozen=True)
class Coordinator:
    """Ports of 127.0.0.1 and a token."""

    # port, token: of the coordinator
    port: int
    token: str
    # the daemon's port for dynamic nodes; None if they cannot reach it
    local_listen_port: int | None

    def raw(self) -> dict[str, Any]:
        """The values for JSON; parse_coordinator reads them."""
        return asdict(self)


def parse_coordinator(raw: object) -> Coordinator:
    """Parse the address of a coordinator. Raises ValueError if it is not valid."""
    if not isinstance(raw, dict):
        raise ValueError("not an object")
    port, listen = (_port(raw.get(key)) for key in ("port", "local_listen_port"))
    return Coordinator(port, parse_token(raw.get("token")), listen)


def parse_token(raw: object) -> str:
    """Parse the token of a coordinator. Raises ValueError if it is not valid."""
    if not isinstance(raw, str) or not _TOKEN.fullmatch(raw):
        raise ValueError("not a token")
    return raw


def _port(raw: object) -> int:
    if type(raw) is not int or not 0 < raw < 65536:
        raise ValueError("not a port")
    return raw

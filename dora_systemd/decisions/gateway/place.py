"""The units of the gateway, its port, and the file of its token."""

import posixpath
import re
from collections.abc import Mapping
from pathlib import Path

from dora_systemd.errors import usage_error
from dora_systemd.scope import Scope
from dora_systemd.values import quoted

SOCKET_UNIT = "dora-gateway.socket"
SERVICE_UNIT = "dora-gateway.service"

ADDRESS = "127.0.0.1"
DEFAULT_PORT = 53290
"""The default port of a coordinator in dora before 1.0."""

DIRECTORY_NAME = "dora-systemd-gateway"
"""RuntimeDirectory= of both units."""

PORT_VARIABLE = "DORA_DAEMON_PORT"
ADDRESS_VARIABLE = "DORA_COORDINATOR_ADDR"

_PORT = r"[0-9]{1,5}"
_LOOPBACK = ("localhost", ADDRESS)
_REMOTE_HINT = "the gateway is for this machine; from another one: ssh -L PORT:127.0.0.1:PORT HOST"


def token_path(scope: Scope) -> Path:
    """The file (mode 0600) of the token that callers of other users need."""
    return scope.runtime_root / DIRECTORY_NAME / "token"


def is_directory_of_user(directory: str) -> bool:
    """Return whether the RuntimeDirectory of a unit is that of a user's manager."""
    return posixpath.normpath(directory).startswith("/run/user/")


def wanted_port(option: int | None, environ: Mapping[str, str]) -> int | None:
    """The requested port, or None.

    Raises DoraSystemdError (USAGE) for variables that do not mean a port of 127.0.0.1.
    """
    address = environ.get(ADDRESS_VARIABLE, "")
    host, _, port = address.partition(":") if address.count(":") < 2 else (address, "", "")
    if address and host not in _LOOPBACK:
        message = f"cannot listen where {ADDRESS_VARIABLE} says: {quoted(address)} is not 127.0.0.1"
        raise usage_error(message, _REMOTE_HINT)
    from_port = _parse(PORT_VARIABLE, environ.get(PORT_VARIABLE, ""))
    from_address = _parse(ADDRESS_VARIABLE, port)
    return next((one for one in (option, from_port, from_address) if one is not None), None)


def port_of(listen: object) -> int | None:
    """The first TCP port in Listen of a socket unit, see org.freedesktop.systemd1(5)."""
    if not isinstance(listen, list | tuple):
        return None
    ports = (str(one[1]).rpartition(":")[2] for one in listen if one[0] == "Stream")
    return next((int(port) for port in ports if port.isdecimal()), None)


def port_drop_in(port: int) -> str:
    """A drop-in for the gateway's socket."""
    listen = f"ListenStream=\nListenStream={ADDRESS}:{port}\n"
    return f"# Written by doractl(1) for up --port.\n[Socket]\n{listen}"


def _parse(variable: str, text: str) -> int | None:
    if not text:
        return None
    if not re.fullmatch(_PORT, text) or not 0 < int(text) < 65536:
        message = f"cannot read {variable}: {quoted(text)} is not a port"
        raise usage_error(message, "a port is 1 to 65535")
    return int(text)

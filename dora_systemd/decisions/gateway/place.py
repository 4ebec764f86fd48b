"""Where the gateway is: its units, its port, and the file with its token."""

import posixpath
from pathlib import Path

from dora_systemd.scope import Scope

SOCKET_UNIT = "dora-gateway.socket"
SERVICE_UNIT = "dora-gateway.service"

ADDRESS = "127.0.0.1"
DEFAULT_PORT = 53290
"""Where the dora command before 1.0 looks for a coordinator by itself."""

DIRECTORY_NAME = "dora-systemd-gateway"
"""RuntimeDirectory= of both units."""


def token_path(scope: Scope) -> Path:
    """The file (mode 0600) with what the gateway asks callers of other users for."""
    return scope.runtime_root / DIRECTORY_NAME / "token"


def is_directory_of_user(directory: str) -> bool:
    """Whether the RuntimeDirectory of a unit is one of a user's manager."""
    return posixpath.normpath(directory).startswith("/run/user/")

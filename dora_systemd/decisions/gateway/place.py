"""The units of the gateway, its port, and the file of its token."""

import posixpath
from pathlib import Path

from dora_systemd.scope import Scope

SOCKET_UNIT = "dora-gateway.socket"
SERVICE_UNIT = "dora-gateway.service"

ADDRESS = "127.0.0.1"
DEFAULT_PORT = 53290
"""The default port of a coordinator in dora before 1.0."""

DIRECTORY_NAME = "dora-systemd-gateway"
"""RuntimeDirectory= of both units."""


def token_path(scope: Scope) -> Path:
    """The file (mode 0600) of the token that callers of other users need."""
    return scope.runtime_root / DIRECTORY_NAME / "token"


def is_directory_of_user(directory: str) -> bool:
    """Whether the RuntimeDirectory of a unit belongs to a user's manager."""
    return posixpath.normpath(directory).startswith("/run/user/")

"""`doractl version`: the versions of doractl, Python, systemd and dora."""

import os
import platform

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.dora.command import dora_version, find_dora
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope


def read_versions(scope: Scope) -> dict[str, str | None]:
    """Versions by name; None for a program that is missing or unreachable."""
    return {
        "doractl": __version__,
        "python": platform.python_version(),
        "systemd": _systemd(scope),
        "dora": _dora(),
    }


def _systemd(scope: Scope) -> str | None:
    try:
        return Bus(scope, for_reading=True).version()
    except DoraSystemdError:
        return None


def _dora() -> str | None:
    try:
        return dora_version(
            find_dora(None, os.environ.get("VIRTUAL_ENV"), os.environ.get("PATH", os.defpath))
        )
    except DoraSystemdError:
        return None

"""`doractl version`: the versions of doractl, Python, systemd and dora."""

import os
import platform
from collections.abc import Callable

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.dora.command import dora_version, find_dora
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope


def read_versions(scope: Scope) -> dict[str, str | None]:
    """Versions by name; None for a program that is missing or unreachable."""
    path = os.environ.get("PATH", os.defpath)
    return {
        "doractl": __version__,
        "python": platform.python_version(),
        "systemd": _found(lambda: Bus(scope, for_reading=True).version()),
        "dora": _found(lambda: dora_version(find_dora(None, os.environ.get("VIRTUAL_ENV"), path))),
    }


def _found(read: Callable[[], str]) -> str | None:
    try:
        return read()
    except DoraSystemdError:
        return None

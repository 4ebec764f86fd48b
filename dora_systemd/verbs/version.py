"""`doractl version`: the versions of doractl, Python, systemd and dora.

own_facts() returns the description of this machine for a head that may use it as a member.
"""

import os
import platform
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from dora_systemd import __version__
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.dora.command import dora_version, find_dora
from dora_systemd.decisions.machines.description import Facts
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name
from dora_systemd.verbs.start.logins import is_lingering


def read_versions(scope: Scope) -> dict[str, str | None]:
    """Versions by name; None for a program that is missing or unreachable."""
    path = os.environ.get("PATH", os.defpath)
    return {
        "doractl": __version__,
        "python": platform.python_version(),
        "systemd": systemd_version(partial(Bus, for_reading=True), scope),
        "dora": _found(lambda: dora_version(find_dora(None, os.environ.get("VIRTUAL_ENV"), path))),
    }


def systemd_version(reach: Callable[[Scope], Manager], scope: Scope) -> str | None:
    """The version of systemd, also while no manager of the user runs.

    reach: opens the connection.
    """
    system = scope._replace(is_user=False)
    return _found(lambda: reach(scope).version()) or _found(lambda: reach(system).version())


def _found(read: Callable[[], str]) -> str | None:
    try:
        return read()
    except DoraSystemdError:
        return None


def own_facts(scope: Scope) -> Facts:
    """Describe the caller's account on this machine."""
    versions = read_versions(scope)
    return Facts(
        doractl=versions["doractl"] or "",
        dora=versions["dora"] or "",
        program=str(Path(sys.argv[0]).absolute()),
        user=user_name(os.getuid()),
        linger=not scope.is_user or is_lingering(scope) is not False,
        now=time.time_ns() // 1000,
    )

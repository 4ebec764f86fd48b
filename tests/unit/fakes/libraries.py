"""Libraries of systemd that need no systemd: what we import of others, not what is ours."""

import sys
from types import ModuleType

import pytest


def install(patch: pytest.MonkeyPatch, name: str, **members: object) -> None:
    """Have `import name` find a module of these members, and a bare package above it."""
    package, _, _ = name.rpartition(".")
    for one in filter(None, (package, name)):
        patch.setitem(sys.modules, one, ModuleType(one))
    vars(sys.modules[name]).update(members)


def hear_notifications(patch: pytest.MonkeyPatch) -> list[str]:
    """What the manager is told from now on, see sd_notify(3)."""
    told: list[str] = []
    install(patch, "systemd.daemon", notify=told.append)
    patch.setenv("NOTIFY_SOCKET", "/nowhere")
    return told

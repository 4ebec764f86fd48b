"""The names of units in the directories of systemd. Imports only what is loaded anyway."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from dora_systemd.scope import Scope, config_home


def unit_places(scope: Scope, environment: Mapping[str, str]) -> Iterator[Path]:
    """Where transient units are, and where doractl enable writes units; see systemd.unit(5)."""
    yield scope.transient_units
    if not scope.is_user:
        yield Path("/etc/systemd/system")
        return
    if config := config_home(environment):
        yield Path(config, "systemd/user")


def has_unit(places: Iterator[Path], prefix: str) -> bool:
    """Whether a unit in one of these directories has a name that begins so."""
    return any(_has_unit(one, prefix) for one in places)


def _has_unit(directory: Path, prefix: str) -> bool:
    with contextlib.suppress(OSError), os.scandir(directory) as entries:
        return any(one.name.startswith(prefix) for one in entries)
    return False

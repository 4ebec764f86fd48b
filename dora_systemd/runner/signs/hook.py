"""Opens notify sockets: without any, nothing else is imported."""

from collections.abc import Callable
from pathlib import Path

from dora_systemd.decisions.signs.watchdogs import Watchdogs
from dora_systemd.paths import CellPaths
from dora_systemd.runner.signs.none import NoSigns


def signs_of(
    watchdogs: Watchdogs, unit: Path, paths: CellPaths, tell: Callable[..., None]
) -> NoSigns:
    """The sockets of the nodes that `watchdogs` gives one: a Signs, or NoSigns."""
    if not watchdogs:
        return NoSigns()
    from dora_systemd.runner.signs.sockets import Signs

    return Signs(watchdogs, unit, paths, tell)

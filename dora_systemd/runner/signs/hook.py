"""Where the rest of the runner meets the notify sockets: without any, nothing else is imported."""

from collections.abc import Callable
from pathlib import Path

from dora_systemd.decisions.signs.table import Sign
from dora_systemd.decisions.signs.watchdogs import Watchdogs
from dora_systemd.paths import CellPaths


class NoSigns:
    """The notify sockets of a dataflow whose nodes have none."""

    is_used = False

    def make(self, node: str) -> None:
        """The node is about to be started. Raises OSError and DoraSystemdError."""

    def remove(self, node: str) -> None:
        """The node does not come back."""

    def forget(self, node: str) -> None:
        """The node's process has ended."""

    def table(self) -> dict[str, Sign]:
        """What the nodes have said of themselves."""
        return {}


def signs_of(
    watchdogs: Watchdogs, unit: Path, paths: CellPaths, tell: Callable[..., None]
) -> NoSigns:
    """The sockets of the nodes that `watchdogs` gives one: a Signs, or NoSigns."""
    if not watchdogs:
        return NoSigns()
    from dora_systemd.runner.signs.sockets import Signs

    return Signs(watchdogs, unit, paths, tell)

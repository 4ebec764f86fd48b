"""The bundles of failures, for rows of dataflows and for `doractl why`."""

from collections.abc import Sequence
from contextlib import suppress

from dora_systemd.adapters.bundles.store import BundleStore
from dora_systemd.decisions.views.rows import Bundles, DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope


def read_of_failures(scope: Scope, name: str) -> Bundles | None:
    """What failures of a dataflow have left; None if that is nothing, or may not be read."""
    with suppress(DoraSystemdError):
        found = BundleStore(scope.state_root, name).of_failures()
        return found if found != Bundles() else None
    return None


def mark_bundles(scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The rows with what failures have left."""
    return [row._replace(bundles=read_of_failures(scope, row.name)) for row in rows]

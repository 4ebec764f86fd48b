"""`doractl bundles`: the bundles in the store; `doractl why --bundle`: the report in a bundle."""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bundles.reader import chunks_of, opened
from dora_systemd.adapters.bundles.store import BundleStore, Stored, unusable
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.bundles.manifest import README, WHY, no_bundle
from dora_systemd.decisions.bundles.readme import fitted
from dora_systemd.decisions.bundles.table import BundleRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import is_name
from dora_systemd.scope import Scope
from dora_systemd.terminal_text import one_line
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import as_mapping
from dora_systemd.verbs.facts.selector import Selector

_MOST_NAMES = 10_000


def store_of(scope: Scope, name: str) -> BundleStore:
    """The bundles of a dataflow."""
    return BundleStore(scope.state_root, name)


def kept_names(scope: Scope) -> list[str]:
    """The dataflows with bundles, sorted. Raises DoraSystemdError (NO_PERMISSION)."""
    root = store_of(scope, "").root
    try:
        return [*filter(is_name, list_directory(root, _MOST_NAMES))]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise unusable(root, error) from error


def find_name(manager: Manager, scope: Scope, selector: str) -> str:
    """The dataflow that is meant: one with bundles, that systemd knows, or that has ended."""
    return Selector(selector).find_name(manager, scope, kept_names(scope))


def read_bundles(scope: Scope, names: Sequence[str]) -> list[BundleRow]:
    """Read the bundles of these dataflows, newest first."""
    found = [(one.place, name, one) for name in names for one in store_of(scope, name).known()]
    return [_row(name, one) for _, name, one in sorted(found, reverse=True)]


def find_bundle(scope: Scope, name: str, ident: str) -> Stored | None:
    """Find a bundle of the dataflow `name` by the name of its file; None if there is none.

    Raises DoraSystemdError (NO_PERMISSION).
    """
    known = store_of(scope, name).known() if name in kept_names(scope) else []
    return next((one for one in known if one.id == ident), None)


def read_parts(one: Stored) -> Iterator[bytes]:
    """Read a bundle of the store in parts. Raises OSError."""
    return chunks_of(one.path)


def _row(name: str, one: Stored) -> BundleRow:
    with suppress(DoraSystemdError), opened(one.path) as bundle:
        return BundleRow(name, one.id, str(one.path), one.event, one.size, bundle.manifest)
    return BundleRow(name, one.id, str(one.path), one.event, one.size, None)


def remove_bundles(scope: Scope, name: str, ids: Sequence[str]) -> Iterator[str]:
    """Remove bundles; yield each. Raises DoraSystemdError (NOT_FOUND), and removes none then."""
    store_of(scope, name).remove(list(ids))
    yield from dict.fromkeys(ids)


def read_report(path: Path) -> tuple[str, bytes]:
    """README.txt and why.json of a bundle that anybody may have written, after a check of all.

    Raises DoraSystemdError (BAD_INPUT).
    """
    with opened(path) as bundle:
        bundle.check()
        return bundle.read(README).decode("utf-8", "replace"), bundle.read(WHY)


def parse_why(data: bytes, path: Path) -> dict[str, Any]:
    """The report in why.json. Raises DoraSystemdError (BAD_INPUT) if it is not JSON."""
    try:
        return as_mapping(json.loads(data))
    except (ValueError, RecursionError) as error:
        raise no_bundle(str(path), "its why.json is not JSON") from error


def shown_readme(text: str, width: int | None = None) -> str:
    """README.txt for a terminal: no text in a bundle controls it."""
    lines = [one_line(line) for line in text.rstrip("\n").split("\n")]
    return "\n".join(lines if width is None else fitted(lines, width))

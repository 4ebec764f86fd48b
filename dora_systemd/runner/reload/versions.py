"""Remembers which versions of its files each node was started with."""

import time
from collections.abc import Iterable, Iterator

from dora_systemd.adapters.host.watch import Identity, identity


class Versions:
    """The identities of the files that each node runs.

    A file of the dataflow itself, such as its settings, stands in the place of a node.
    """

    def __init__(self) -> None:
        self._known: dict[str, dict[str, Identity | None]] = {}

    def take(self, node: str, paths: Iterable[str]) -> None:
        """Note that `node` runs the present versions of `paths`, and no other files."""
        self._known[node] = _identities(paths)

    def merge(self, taken: "Versions") -> None:
        """Note what was taken before, once it is true."""
        self._known |= taken._known

    def add(self, node: str, paths: Iterable[str], begun_ns: int) -> None:
        """Note the present versions of those `paths` that are not known yet.

        A file that was written since `begun_ns` stays unknown: the node may run an older version.
        One that seems to be written later than now is from before somebody set the clock.
        """
        known = self._known.setdefault(node, {})
        present = _identities(set(paths) - known.keys())
        now_ns = time.time_ns()  # not earlier: a file can be saved while others are looked up
        for path, one in present.items():
            if one is None or not begun_ns < one.changed_ns <= now_ns:
                known[path] = one

    def known(self) -> Iterator[tuple[str, Identity | None]]:
        """The known versions of all files. May be called in any thread."""
        for files in list(self._known.values()):
            yield from list(files.items())

    def differ(self, path: str) -> bool:
        """Whether a file of the dataflow itself is another one, or has come or gone."""
        return self._known.get(path, {}).get(path) != identity(path)

    def stale(self, node: str, paths: Iterable[str]) -> set[str]:
        """Return those `paths` of which another version is there than `node` runs."""
        known = self._known.get(node, {})
        now = _identities(paths)
        return {path for path, one in now.items() if one is not None and known.get(path) != one}


def _identities(paths: Iterable[str]) -> dict[str, Identity | None]:
    return {path: identity(path) for path in paths}

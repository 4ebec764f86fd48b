"""What a deploy or rollback that was killed has left: doctor names it, clean.py removes it."""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.unit_files import remains_of
from dora_systemd.adapters.releases.store import Store
from dora_systemd.verbs.releases.trial import Standing


def remains(store: Store, standing: Standing) -> Iterator[Path]:
    """Files and directories that nothing uses."""
    used = {store.release(one) for one in (standing.current, standing.trial) if one}
    yield from (path for path in store.unfinished() if path not in used)
    for place in (standing.boot.path, standing.path):
        yield from remains_of(place)

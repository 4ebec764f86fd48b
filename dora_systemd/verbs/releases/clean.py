"""Removes what a deploy or rollback that was killed has left; both call it first.

Apart from remains.py, which a list of releases needs, and which knows nothing of builds.
"""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.store import Store, remove_tree
from dora_systemd.decisions.releases.build import build_unit
from dora_systemd.verbs.releases.build import end_former
from dora_systemd.verbs.releases.remains import remains
from dora_systemd.verbs.releases.trial import Standing


def clean(manager: Manager, store: Store, standing: Standing) -> None:
    """Remove them, after the end of a build that still runs in one of them.

    The caller holds the lock of the store. Raises DoraSystemdError.
    """
    if store.unfinished():
        end_former(manager, build_unit(store.name))
    for path in remains(store, standing):
        remove_tree(path)

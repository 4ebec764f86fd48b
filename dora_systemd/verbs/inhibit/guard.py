"""What restarts a dataflow asks here first: no lock may inhibit it."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from pathlib import Path

from dora_systemd.decisions.views.inhibitors import format_holders
from dora_systemd.decisions.views.rows import Holder
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import Named
from dora_systemd.scope import Scope
from dora_systemd.trust.locks import open_lock, take_lock
from dora_systemd.verbs.facts.locks import holders_of, read_cell_flocks

_POLL_SECONDS = 0.2

Tell = Callable[[str], None]


class IfInhibited(Enum):
    """What to do with a dataflow whose restart is inhibited."""

    REFUSE = "refuse"
    WAIT = "wait"
    FORCE = "force"


@contextmanager
def uninhibited(
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited = IfInhibited.REFUSE,
    tell: Tell | None = None,
) -> Iterator[None]:
    """Hold the locks of the dataflows exclusively, so that no new lock can inhibit them meanwhile.

    A lock file that a restart replaces is not held any more. verb: what is done to them, for the
    error. tell: called again and again with what is waited for.

    Raises DoraSystemdError: INHIBITED if a lock of one of them is held, BAD_INPUT for a lock file
    that is not usable.
    """
    with ExitStack() as held:
        if how is not IfInhibited.FORCE:
            _hold(held, scope, dataflows, verb, how, tell)
        yield


def require_uninhibited(
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited = IfInhibited.REFUSE,
    tell: Tell | None = None,
) -> None:
    """As uninhibited(), for an action during which nodes may take the lock."""
    with uninhibited(scope, dataflows, verb, how, tell):
        pass


def _hold(
    held: ExitStack,
    scope: Scope,
    dataflows: Sequence[Named],
    verb: str,
    how: IfInhibited,
    tell: Tell | None,
) -> None:
    while (one := _locked(held, scope, dataflows)) is not None:
        held.close()  # do not keep nodes of the others from their locks meanwhile
        error = _inhibited(scope, one, verb)
        if how is IfInhibited.REFUSE:
            raise error
        if tell is not None:
            tell(f"{error.message}; waiting for its end")
        time.sleep(_POLL_SECONDS)


def _locked(held: ExitStack, scope: Scope, dataflows: Sequence[Named]) -> Named | None:
    """Take all locks into `held`; the first dataflow whose lock another process holds, or None."""
    for one in dataflows:
        lock = _open(scope, one)
        if lock is None:
            continue
        held.callback(os.close, lock)
        if not _take(scope.cell_directory(one.name), lock):
            return one
    return None


def _open(scope: Scope, dataflow: Named) -> int | None:
    try:
        return open_lock(scope.cell_directory(dataflow.name))
    except DoraSystemdError as error:
        if not read_cell_flocks(scope):
            return None  # whatever the file is, nobody holds a lock
        hint = "use sudo, or --force to do it in any case"
        raise DoraSystemdError(error.message, hint, error.code) from error


def _take(directory: Path, lock: int) -> bool:
    try:
        return take_lock(directory, lock, is_shared=False)
    except DoraSystemdError as error:
        hint = "whether it is inhibited is not known; --force does it anyway"
        raise DoraSystemdError(error.message, hint, error.code) from error


def _inhibited(scope: Scope, dataflow: Named, verb: str) -> DoraSystemdError:
    holders: Sequence[Holder] = ()
    with suppress(DoraSystemdError):
        holders = holders_of(scope, dataflow.name, read_cell_flocks(scope))
    # The kernel does not name a process that has passed its lock on to a child and has ended.
    who = format_holders(holders or (Holder(0),))
    message = f"cannot {verb} {dataflow.name}: inhibited by {who}"
    hint = "--wait waits until it is free, --force does it anyway; see doractl inhibit"
    return DoraSystemdError(message, hint, ExitCode.INHIBITED)

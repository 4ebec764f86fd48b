"""Which releases are kept, and which one a rollback takes. Pure."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

CURRENT, TRIAL, PROVED, UNPROVED = "current", "trial", "proved", "unproved"
UNKNOWN = "unknown"


class Known(NamedTuple):
    """A release in the store. is_proved: it has passed a trial."""

    id: str
    is_proved: bool


def state_of(one: Known, current: str, trial: str) -> str:
    """The state in one word. current: what the unit file on the disk starts. trial: on trial."""
    if one.id == trial:
        return TRIAL
    if one.id == current:
        return CURRENT
    return PROVED if one.is_proved else UNPROVED


def before(releases: Sequence[Known], current: str) -> str:
    """The newest release older than `current` that has passed its trial, or "".

    The times in the ids decide. current: "" for the newest of all.
    """
    older = [one.id for one in releases if one.is_proved and (not current or one.id < current)]
    return max(older, default="")


def surplus(
    releases: Sequence[Known], keep: int, current: str, used: Collection[str] = ()
) -> list[str]:
    """The releases that go, oldest first: all but the `keep` newest ones.

    The current one, the one before it and those of `used` stay in any case.
    """
    newest = sorted((one.id for one in releases), reverse=True)
    stay = {*newest[:keep], current, before(releases, current), *used}
    return sorted(one for one in newest if one not in stay)

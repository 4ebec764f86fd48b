"""Which releases are kept, and which one a rollback takes. Pure."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from dora_systemd.decisions.releases.past import Switch, marks, runs

CURRENT, TRIAL, PROVED, UNPROVED = "current", "trial", "proved", "unproved"
UNKNOWN = "unknown"


class Known(NamedTuple):
    """A release in the store. is_proved: it has passed a trial."""

    id: str
    is_proved: bool


def state_of(one: Known, current: str, trial: str, mark: Switch | None = None) -> str:
    """The state in one word. current: what the unit file on the disk starts. trial: on trial.

    mark: its own of marks().
    """
    if one.id == trial:
        return TRIAL
    if one.id == current:
        return CURRENT
    if mark:
        return mark.how
    return PROVED if one.is_proved else UNPROVED


def before(releases: Sequence[Known], current: str, history: Sequence[Switch] = ()) -> str:
    """The release that ran well before `current`, or "".

    Never one that has failed a trial or was rolled back from since it ran well. current: "" for
    what ran last. history: completed().
    """
    bad = marks(history)
    good = {one.id for one in releases if one.is_proved}
    ran = runs(history, good)
    if current in ran:
        ran = ran[: ran.index(current)]
    return next((one for one in reversed(ran) if one in good and one not in bad), "")


def surplus(
    releases: Sequence[Known],
    keep: int,
    current: str,
    used: Collection[str] = (),
    history: Sequence[Switch] = (),
) -> list[str]:
    """The releases that go, oldest first: all but `keep`.

    Those that have not run well go before those that have, and older ones before newer ones. The
    current one, the one before it and those of `used` stay in any case.
    """
    bad = marks(history)
    ids = sorted((one.id for one in releases), reverse=True)
    good = [one.id for one in releases if one.is_proved and one.id not in bad]
    ranked = [*sorted(good, reverse=True), *(one for one in ids if one not in good)]
    stay = {*ranked[:keep], current, before(releases, current, history), *used}
    return sorted(one for one in ids if one not in stay)

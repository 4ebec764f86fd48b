"""Makes the ids of releases; names.py reads them."""

import calendar
import re
import time

from dora_systemd.values import SECOND

_REVISION = re.compile(r"[0-9a-f]{4,64}\+?")
_MOMENT = "%Y%m%dT%H%M%S"
_MOMENT_LENGTH = 15


def is_revision(text: str) -> bool:
    """Whether it is a revision of git in hexadecimal digits, "+" behind it for changed files."""
    return _REVISION.fullmatch(text) is not None


def new_id(at_us: int, revision: str, known: frozenset[str]) -> str:
    """The id of a release of that time, that sorts behind all of `known`.

    at_us: CLOCK_REALTIME µs. revision: of git, or "".
    """
    newest = max(known, default="")
    now = _id(at_us // SECOND, revision)
    # The clock may have been ahead, or be behind, as without a battery.
    return now if now > newest else _id(_second_of(newest) + 1, revision)


def _id(second: int, revision: str) -> str:
    moment = time.strftime(_MOMENT, time.gmtime(second))
    return f"{moment}-{revision}" if revision else moment


def _second_of(release_id: str) -> int:
    return calendar.timegm(time.strptime(release_id[:_MOMENT_LENGTH], _MOMENT))

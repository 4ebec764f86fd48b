"""Makes the ids of releases; names.py reads them."""

import re
import time

from dora_systemd.values import SECOND

_REVISION = re.compile(r"[0-9a-f]{4,64}\+?")
_MOST_AT_ONCE = 10_000


def is_revision(text: str) -> bool:
    """Whether it is a revision of git in hexadecimal digits, "+" behind it for changed files."""
    return _REVISION.fullmatch(text) is not None


def new_id(at_us: int, revision: str, known: frozenset[str]) -> str:
    """The id of a release of that time, which none of `known` has, and that sorts behind them.

    at_us: CLOCK_REALTIME µs. revision: of git, or "".
    """
    moment = time.strftime("%Y%m%dT%H%M%S", time.gmtime(at_us // SECOND))
    plain = f"{moment}-{revision}" if revision else moment
    numbered = (f"{plain}.{count}" for count in range(1, _MOST_AT_ONCE))
    return plain if plain not in known else next(one for one in numbered if one not in known)

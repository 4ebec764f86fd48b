"""Names of releases, and how a path tells which one it is in.

There is no registry: the unit names its dataflow file, and that path has the release in it. `list`
uses this module, so it imports only what loads quickly.
"""

import re
import time

from dora_systemd.values import SECOND

_TEXT = r"[0-9]{8}T[0-9]{6}(?:-[0-9a-f]{4,64}\+?)?(?:\.[0-9]{1,4})?"
_ID = re.compile(_TEXT)
STORE = "dora-systemd/releases"
"""The directory of all releases, below that of states."""
TREE = "tree"
"""The directory of a project's files in a release."""
_PLACE = re.compile(rf"/{STORE}/[^/]+/({_TEXT})/{TREE}/")
_REVISION = re.compile(r"[0-9a-f]{4,64}\+?")
_MOST_AT_ONCE = 10_000


def is_release_id(text: str) -> bool:
    """Whether it is the id of a release, such as 20261121T220012-9f3c1a2."""
    return _ID.fullmatch(text) is not None


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


def release_of(path: str) -> str:
    """The release that a file is in, "" if it is in none."""
    found = _PLACE.search(path)
    return found[1] if found else ""

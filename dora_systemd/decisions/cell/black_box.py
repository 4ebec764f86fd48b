"""The setting `black_box`: which bundles of failures are kept. Pure."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.values import SECOND, format_size, parse_bool, parse_size, quoted

KEYS = ("keep", "size")
_MOST_KEPT = 100
_LEAST_EACH = 1024 * 1024
QUIET = 600 * SECOND
"""After a bundle the next one of the same node and cause is written no earlier."""
AFTER_BOOT = 600 * SECOND
"""Until then after a boot a bundle of what ran before a power cut is written: CLOCK_BOOTTIME."""
_HINT = "write {keep: 5, size: 100M}, yes or no"


class BlackBox(NamedTuple):
    """How many bundles of failures are kept, and how many bytes they have together."""

    keep: int = 5
    size: int = 100 * 1024 * 1024

    @property
    def most(self) -> int:
        """Maximum bytes of one: all of them together are never larger than `size`."""
        return self.size // self.keep


def is_after_boot(box: BlackBox | None, now_us: int) -> bool:
    """Whether a bundle of what ran before a power cut may be written. now_us: CLOCK_BOOTTIME."""
    return box is not None and now_us < AFTER_BOOT


class Past(NamedTuple):
    """An earlier bundle of a failure. id: the name of its file."""

    id: str
    event: str
    at_us: int = 0
    node: str = ""
    cause: str = ""


def parse_black_box(text: str) -> BlackBox | None:
    """The value of `keep=N,size=SIZE`, yes or no. Raises DoraSystemdError (USAGE)."""
    if "=" not in text:
        try:
            return BlackBox() if parse_bool(text) else None
        except DoraSystemdError as error:
            raise _refusal(text) from error
    pairs = (part.partition("=") for part in text.split(","))
    return black_box_of({key.strip(): value.strip() for key, _, value in pairs})


def black_box_of(texts: Mapping[str, str]) -> BlackBox:
    """The value of these keys. Raises DoraSystemdError (USAGE)."""
    unknown = next((key for key in texts if key not in KEYS), None)
    if unknown is not None:
        raise _refusal(unknown)
    keep = texts.get("keep", str(BlackBox().keep))
    if not (keep.isascii() and keep.isdigit() and len(keep) < 4 and 0 < int(keep) <= _MOST_KEPT):
        raise _refusal(f"keep={keep}", f"keep is a number from 1 to {_MOST_KEPT}")
    size = parse_size(texts["size"]) if "size" in texts else BlackBox().size
    found = BlackBox(int(keep), size)
    if not _LEAST_EACH <= found.most < 2**50:
        least = format_size(_LEAST_EACH * found.keep)
        raise _refusal(f"size={texts.get('size', '')}", f"{keep} bundles need at least {least}")
    return found


def format_black_box(box: BlackBox | None) -> str:
    """Inverse of parse_black_box()."""
    return f"keep={box.keep},size={format_size(box.size)}" if box else "no"


def _refusal(text: str, hint: str = _HINT) -> DoraSystemdError:
    return usage_error(f"cannot use {quoted(text)} as black_box", hint)


def to_remove(known: Sequence[Past], keep: int) -> list[str]:
    """The bundles that make room for one more: the oldest of the event with most of them.

    known: oldest first. So a node that crashes all night does not remove the only bundle of
    another event.
    """
    left, gone = list(known), []
    while len(left) >= keep:
        counts = Counter(one.event for one in left)
        victim = max(left, key=lambda one: counts[one.event])
        left.remove(victim)
        gone.append(victim.id)
    return gone


def is_too_soon(known: Iterable[Past], node: str, cause: str, now_us: int) -> bool:
    """Whether a bundle of the same node and cause is younger than QUIET.

    One from the future is of a clock that was set back, and does not count.
    """
    same = (one for one in known if (one.node, one.cause) == (node, cause))
    return any(0 <= now_us - one.at_us < QUIET for one in same)

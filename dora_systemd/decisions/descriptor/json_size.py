"""Checks that a loaded document is JSON of a limited size, without walking all of a huge one."""

import math
import re
from collections.abc import Iterator

from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import shown

MAX_DEPTH = 64
"""Maximum nesting: no dataflow needs more, and Python's recursion ends at some hundreds."""

_MAX_NUMBER = 2**64


def check_json(document: object, source: str, max_bytes: int) -> None:
    """Raise DoraSystemdError (BAD_INPUT) unless `document` is a JSON value of at most `max_bytes`.

    YAML anchors can multiply, or contain themselves: small in memory, and endless as text. So the
    walk stops as soon as the limit is exceeded.
    """
    size = 0
    waiting = [(document, 1)]
    while waiting:
        value, depth = waiting.pop()
        size += _size(value, source)
        if size > max_bytes:
            hint = f"{max_bytes // 1024} KiB is the maximum; check for anchors that repeat a lot"
            raise refusal(source, "it is too large once its anchors are written out", hint)
        if depth > MAX_DEPTH:
            raise refusal(source, f"it is nested more than {MAX_DEPTH} levels deep", "flatten it")
        waiting += [(child, depth + 1) for child in _children(value, source)]


def _size(value: object, source: str) -> int:
    """Bytes of `value` as JSON without its children; at least 1, so that every walk ends."""
    if isinstance(value, str):
        return _text_size(value, source)
    if value is None or isinstance(value, dict | list):
        return 4
    if isinstance(value, bool | int) and abs(value) < _MAX_NUMBER:
        return 20
    if isinstance(value, float) and math.isfinite(value):
        return 20
    if isinstance(value, int):
        raise refusal(source, "a number in it is too large for JSON", "write it as text")
    if isinstance(value, float):
        kind = "not a number (.nan)" if math.isnan(value) else "infinite (.inf)"
        raise refusal(source, f"a value in it is {kind}", "write a finite number")
    kind = type(value).__name__
    raise refusal(source, f"a value in it is of type {kind}", "write plain text or a number")


def is_infinite(value: str | float) -> bool:
    """Whether dora makes of it a number that JSON cannot hold: infinite, or not a number."""
    if isinstance(value, str) and (not value.isascii() or re.search(r"[_\s]", value)):
        return False  # only Python reads these as numbers
    try:
        return not math.isfinite(float(value))
    except ValueError:
        return False


def _text_size(value: str, source: str) -> int:
    try:
        return len(value.encode()) + 4
    except UnicodeEncodeError as error:
        raise refusal(source, "a text in it is not Unicode", "save the file as UTF-8") from error


def _children(value: object, source: str) -> Iterator[object]:
    if isinstance(value, dict):
        for key, child in value.items():
            if not isinstance(key, str):
                kind = f"a key in it is {type(key).__name__}, not text"
                raise refusal(source, kind, "put the key in quotes")
            yield key
            yield child
    elif isinstance(value, list):
        yield from value


def refusal(source: str, reason: str, hint: str) -> DoraSystemdError:
    """The error (BAD_INPUT) for a descriptor or settings file `source` that cannot be used."""
    return bad_input(f"cannot use {shown(source)}: {reason}", hint)

"""Inputs by hypothesis: any bytes, values of JSON, and kept inputs that were changed a little."""

import json
from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

PARTS = (
    *(b"{", b"}", b'"', b"\\ud800", b"\x00", b"\x1b[", b"\n", b": ", b"- ", b"1e999", b"-1", b"~"),
    *(b"NaN", b"9" * 30, b"[" * 200, b"&a", b"*a", b"\xff", b"null", b"true", b"\xe2\x80\xa8"),
)
"""What readers stumble over."""
MOST_CHANGES = 4

_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES: st.SearchStrategy[Any] = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)


@st.composite
def changed(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """A kept input in which a few pieces are other ones."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.integers(1, MOST_CHANGES))):
        first = draw(st.integers(0, len(data)))
        last = min(first + draw(st.integers(0, 12)), len(data))
        data = data[:first] + draw(st.sampled_from(PARTS) | st.binary(max_size=4)) + data[last:]
    return data


@st.composite
def revalued(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """A kept input, if it is JSON, in which one value somewhere is any other one."""
    try:
        document = json.loads(draw(st.sampled_from(seeds)))
    except ValueError:
        return draw(changed(seeds))
    place, value = document, draw(VALUES)
    while isinstance(place, dict | list) and place:
        keys: list[Any] = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = draw(st.sampled_from(keys))
        if not isinstance(place[key], dict | list) or draw(st.booleans()):
            place[key] = value
            break
        place = place[key]
    return json.dumps(document).encode()


def inputs(seeds: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """All of these."""
    whole = VALUES.map(lambda value: json.dumps(value).encode())
    return st.one_of(changed(seeds), revalued(seeds), whole, st.binary(max_size=60))

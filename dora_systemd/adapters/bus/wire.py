"""Converts values to and from the form that pystemd's call_method() uses."""

import os
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_readable

_CLOSE = (-1, None)
"""pystemd's mark for the end of a container."""


def encoded(signature: str, value: Any) -> list[tuple[int, Any]]:
    """`value` as the sequence of basic types and containers for call_method().

    A variant's value is a pair of its signature and its value.
    """
    kind = signature[0]
    if kind == "a":
        items = [word for one in value for word in encoded(signature[1:], one)]
        return [(ord("a"), signature[1:].encode()), *items, _CLOSE]
    if kind == "(":
        pairs = zip(_split(signature[1:-1]), value, strict=True)
        items = [word for inner, one in pairs for word in encoded(inner, one)]
        return [(ord("r"), signature[1:-1].encode()), *items, _CLOSE]
    if kind == "v":
        return [(ord("v"), value[0].encode()), *encoded(*value), _CLOSE]
    return [(ord(kind), _text(value) if kind in "sog" else value)]


def _text(value: str) -> bytes:
    if not is_readable(value):
        hint = "write it as UTF-8, without NUL and noncharacters"
        raise DoraSystemdError(f"cannot send {value!r} to systemd", hint, ExitCode.USAGE)
    return value.encode()


def _split(signature: str) -> list[str]:
    """The complete types of a signature: "sasb" gives s, as, b."""
    types, current, depth = [], "", 0
    for char in signature:
        current += char
        depth += (char == "(") - (char == ")")
        if char != "a" and depth == 0:
            types.append(current)
            current = ""
    return types


def decoded(value: Any) -> Any:
    """The body of a message of pystemd, with str for bytes and lists for tuples."""
    if isinstance(value, bytes):
        return os.fsdecode(value)
    if isinstance(value, dict):
        return {decoded(key): decoded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [decoded(one) for one in value]
    return value

"""What comes from a host: bytes after the mark, lines of them, objects with the host. Pure."""

import json
from typing import Any

_NOISE = 4096
MAX_LINE = 1 << 20
"""A line that is longer is taken as several: no host can fill our memory."""
_MOST_LEVELS = 100
"""Far more than an answer of doractl has, and less than json can write anywhere."""


class AfterMark:
    """Drops what a login shell prints before doractl does. noise: the last bytes of that."""

    def __init__(self, mark: str) -> None:
        self._mark = f"{mark}\n".encode()
        self.noise = b""
        self.is_open = False

    def feed(self, data: bytes) -> bytes:
        if self.is_open:
            return data
        before, mark, after = (self.noise + data).partition(self._mark)
        self.is_open = bool(mark)
        self.noise = before[-_NOISE:]
        return after


class Lines:
    """Splits a stream into lines without their ends."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        """The lines that `data` completes."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE:
            lines.append(self._rest)
            self._rest = b""
        return [line.decode("utf-8", "replace") for line in lines]

    def flush(self) -> list[str]:
        """The last line, if it has no end."""
        rest, self._rest = self._rest, b""
        return [rest.decode("utf-8", "replace")] if rest else []


def read_json(text: str) -> Any:
    """The value in a text; None if it is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def read_object(text: str) -> dict[str, Any] | None:
    """Parse the object in a text; None for other text, and for one of too many levels."""
    value = read_json(text)
    return value if isinstance(value, dict) and _is_printable(value) else None


def with_host(value: dict[str, Any], host: str, key: str = "host") -> dict[str, Any]:
    """An object of -o json with the host that it comes from. key: the name that it gets there."""
    schema = {"schema": value["schema"]} if "schema" in value else {}
    rest = {name: one for name, one in value.items() if name not in ("schema", key)}
    return {**schema, key: host, **rest}


def objects_of(text: str, host: str) -> list[dict[str, Any]] | None:
    """Parse an object, or a list of objects, and add the host to each; None as in read_object()."""
    value = read_json(text)
    if not _is_printable(value):
        return None
    found = value if isinstance(value, list) else [value]
    if not all(isinstance(one, dict) for one in found):
        return None
    return [with_host(one, host) for one in found]


def _is_printable(value: object, levels: int = _MOST_LEVELS) -> bool:
    """Whether json can write what it has read: Python reads deeper lists than it writes."""
    if not isinstance(value, dict | list):
        return True
    parts = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(_is_printable(one, levels - 1) for one in parts)

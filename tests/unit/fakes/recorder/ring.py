"""The file of a ring in memory, which knows what its pages take."""

from collections.abc import Sequence
from typing import Any

from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    Header,
    format_header,
    size_of,
    span_of,
)
from dora_systemd.decisions.recorder.writer import Message, Writer

PAGE = 4096
SECOND = 1_000_000_000


class MemoryStore:
    """As a memfd: a write touches its pages, a hole frees them."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.pages: dict[int, bytearray] = {}
        self.left = -1
        """Bytes until the writing process is killed; -1 is never."""

    def write(self, at: int, parts: Sequence[Any]) -> None:
        data = b"".join(map(bytes, parts))
        if 0 <= self.left < len(data):
            self._put(at, data[: self.left])
            raise KeyboardInterrupt
        if self.left >= 0:
            self.left -= len(data)
        self._put(at, data)

    def _put(self, at: int, data: bytes) -> None:
        assert at + len(data) <= self.size
        for offset, byte in enumerate(data, at):
            self.pages.setdefault(offset // PAGE, bytearray(PAGE))[offset % PAGE] = byte

    def read(self, at: int, size: int) -> bytes:
        size = max(min(size, self.size - at), 0)
        first, last = at // PAGE, (at + size) // PAGE
        empty = bytes(PAGE)
        data = b"".join(bytes(self.pages.get(one, empty)) for one in range(first, last + 1))
        return data[at - first * PAGE :][:size]

    def punch(self, at: int, size: int) -> None:
        assert at % PAGE == size % PAGE == 0
        for one in range(at // PAGE, (at + size) // PAGE):
            self.pages.pop(one, None)

    def used_from(self, at: int) -> int:
        """Bytes of the pages behind a place."""
        return sum(one >= at // PAGE for one in self.pages) * PAGE


def ring(budget: int = 16 * PAGE, outputs: int = 2, **more: Any) -> tuple[MemoryStore, Header]:
    names = [f"node/out{at}" for at in range(outputs)]
    given: dict[str, Any] = {"last": 30 * SECOND, "only_small": False, "facts": {}, **more}
    header = Header(names, span_of(budget), budget, **given)
    store = MemoryStore(size_of(header))
    store.write(0, [format_header(header)])
    return store, header


def writer(store: MemoryStore) -> Writer:
    return Writer(store, PAGE)


def message(data: bytes, at_ns: int = 0, schema: bytes = b"schema") -> Message:
    return Message(schema, b"{}", data, at_ns + 1, at_ns, at_ns + 2)


def start_of_tapes(header: Header) -> int:
    return ALIGN * (1 + len(header.outputs))

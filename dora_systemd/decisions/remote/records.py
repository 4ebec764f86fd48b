"""Records of the journal of another host. Pure. It can lie about them, and about their times."""

from collections.abc import Iterator
from typing import Any

from dora_systemd.decisions.logs.fields import ExportReader
from dora_systemd.decisions.remote.stream import Lines, read_json

TIME = "__REALTIME_TIMESTAMP"
_MOST_BYTES = 4 << 20
"""Of one record that is not complete."""
_MOST_TIME = 253_370_764_800_000_000
"""The year 9999, in µs."""


class Records:
    """The records of one host, from its output. Each has its time and what is printed of it."""

    def __init__(self) -> None:
        self._pending = 0
        self._reader = ExportReader()
        self._lines = Lines()

    @property
    def is_too_much(self) -> bool:
        """Whether a record is larger than any."""
        return self._pending > _MOST_BYTES

    def exported(self, data: bytes) -> list[dict[str, bytes]]:
        """The records that `data` completes, in the export format, with times that can be."""
        found = self._reader.feed(data)
        self._pending = 0 if found else self._pending + len(data)
        for record in found:
            record[TIME] = b"%d" % time_of(record.get(TIME))
        return found

    def objects(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The objects that `data` completes, of -o json."""
        for line in self._lines.feed(data):
            if isinstance(value := read_json(line), dict):
                yield value


def time_of(value: object) -> int:
    """A time of the journal as µs; 0 for what is none."""
    try:
        number = int(value) if isinstance(value, str | bytes) else 0
    except ValueError:
        return 0
    return number if 0 <= number <= _MOST_TIME else 0

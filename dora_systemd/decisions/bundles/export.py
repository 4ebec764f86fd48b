"""Records of the journal as a file that systemd-journal-remote(8) reads: the export format. Pure.

https://systemd.io/JOURNAL_EXPORT_FORMATS
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from dora_systemd.decisions.bundles.allowlist import kept_record
from dora_systemd.decisions.logs.fields import Value, encode_entry

LIVES = 2
"""This life and the last one."""
_ADDRESS = ("__CURSOR", "__REALTIME_TIMESTAMP", "__MONOTONIC_TIMESTAMP", "_BOOT_ID")
_LIFE = ("_SYSTEMD_INVOCATION_ID", "INVOCATION_ID", "USER_INVOCATION_ID")


def export_entry(record: Mapping[str, Any]) -> bytes:
    """A record as an entry. record: of journalctl's JSON, see "json" in journalctl(1)."""
    kept = kept_record(record)
    order = (*(key for key in _ADDRESS if key in kept), *(kept.keys() - {*_ADDRESS}))
    return b"".join(_field(key, kept[key]) for key in order) + b"\n"


def _field(name: str, value: Any) -> bytes:
    return b"".join(encode_entry({name: one}) for one in _values(value))


def _values(value: Any) -> Iterator[Value]:
    """Yield the values of a field: JSON has a list of bytes for binary ones, null for long ones."""
    if not isinstance(value, list):
        if isinstance(value, str | int):
            yield value
    elif all(isinstance(one, int) and 0 <= one < 256 for one in value):
        yield bytes(value)
    else:
        for one in value:
            yield from _values(one)


def of_lives(records: Iterable[Mapping[str, Any]], most: int) -> Iterator[Mapping[str, Any]]:
    """Yield the records of the last LIVES lives, newest first, at most `most`.

    records: of one dataflow and its unit, newest first.
    """
    seen: set[str] = set()
    for count, record in enumerate(records):
        life = next((str(record[key]) for key in _LIFE if record.get(key)), "")
        if life:
            seen.add(life)
        if len(seen) > LIVES or count == most:
            return
        yield record

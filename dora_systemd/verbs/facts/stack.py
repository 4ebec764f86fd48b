"""Reads the stack of a node that a signal ended from the journal."""

import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from dora_systemd.adapters.journal.reader import JournalReader, read_when_written
from dora_systemd.decisions.cell.core_dumps import CORE_PATTERN, keeps_core_dumps
from dora_systemd.decisions.logs.query import scope_matches
from dora_systemd.decisions.why.lives import parse_number, plain_text
from dora_systemd.decisions.why.stack import (
    DUMP_FIELDS,
    MOST_FRAMES,
    NATIVE,
    Crash,
    Frame,
    crash_of,
    dump_matches,
    find_dump,
    python_frames,
    without_handler,
)
from dora_systemd.decisions.why.verdict import Verdict
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND

_ROOT = Path("/")
_MOST_DUMPS = 100
_MOST_LINES = 1000
_FRESH = 10 * SECOND
"""µs in which systemd-coredump may still be writing the record of a crash."""


def read_pattern(root: Path = _ROOT) -> str:
    """The value of kernel.core_pattern, "" if it cannot be read. root: has all files."""
    try:
        return (root / CORE_PATTERN).read_text(errors="replace").strip()
    except OSError:
        return ""


def read_stack(
    journal: JournalReader, scope: Scope, name: str, verdict: Verdict
) -> tuple[Frame, ...]:
    """The stack of the node that failed first, native frames first; () without one."""
    crash = crash_of(verdict)
    if crash is None:
        return ()
    python = python_frames(_lines(journal, scope, name, verdict))
    native = _read_dump(journal, scope, name, crash)
    if python:
        native = without_handler(native)
    own = [one for one in python if not (native and one.language == NATIVE)]
    return (*native[:MOST_FRAMES], *own)


def _read_dump(journal: JournalReader, scope: Scope, name: str, crash: Crash) -> tuple[Frame, ...]:
    unit = unit_name(name)
    matches = dump_matches(scope, unit)

    def read() -> tuple[Frame, ...] | None:
        records = journal.newest(matches, _MOST_DUMPS, is_whole=True, fields=DUMP_FIELDS)
        return find_dump(records, unit, crash)

    age = time.time() * SECOND - crash.until_us
    is_due = age < _FRESH and keeps_core_dumps(read_pattern())
    return read_when_written(read, lambda found: is_due and found is None) or ()


def _lines(journal: JournalReader, scope: Scope, name: str, verdict: Verdict) -> Iterator[str]:
    """What the process of the node has written to stderr, newest first."""
    matches = [*scope_matches(scope, name), f"_SYSTEMD_INVOCATION_ID={verdict.invocation}"]
    matches += [f"DORA_NODE={verdict.node}", "DORA_STREAM=stderr"]
    if pid := parse_number(verdict.details.get("node_pid", "")):
        matches.append(f"DORA_NODE_PID={pid}")
    records = journal.newest(matches, _MOST_LINES, until_us=verdict.at_us, is_whole=True)
    return (plain_text(one.get("MESSAGE")) for one in islice(records, _MOST_LINES))

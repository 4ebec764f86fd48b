"""Reads the lives of a dataflow from the journal."""

from itertools import islice
from pathlib import Path

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.query import story_matches
from dora_systemd.decisions.why.lives import Life, find_lives, parse_happening
from dora_systemd.scope import Scope

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_MOST_RECORDS = 1000


def read_lives(
    journal: JournalReader, scope: Scope, name: str, uuid: str, is_loaded: bool
) -> list[Life]:
    """The lives of the dataflow in the journal, oldest first, without others of the same name."""
    matches = story_matches(scope, name, uuid)
    records = islice(journal.newest(matches, None, is_whole=True), _MOST_RECORDS)
    found = [one for one in map(parse_happening, records) if one is not None]
    lives = find_lives(reversed(found))
    own = [place for place, life in enumerate(lives) if life.is_of(uuid)]
    # A life that failed before our code ran has no UUID: it belongs to the loaded dataflow.
    begin = own[0] if own else -1
    return lives[begin:] if is_loaded else lives[begin : own[-1] + 1 if own else 0]


def now_boot() -> str:
    """The id of this boot, "" if it is not known."""
    try:
        return _BOOT_ID.read_text().strip().replace("-", "")
    except OSError:
        return ""

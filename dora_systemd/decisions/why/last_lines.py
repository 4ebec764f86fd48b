"""Chooses the last lines to show of nodes that failed. Pure.

Lines that nodes wrote precede lines that dora wrote in their name or about them; dora's errors
count as lines of the node. A line that a node repeats is one line.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from dora_systemd.decisions.logs.lines import ERR
from dora_systemd.decisions.logs.noise import is_same, is_told_by_event, repeated
from dora_systemd.decisions.why.lives import plain_text

_MOST_READ = 1000
_LIBRARIES = ("dora_", "zenoh")
"""How the targets of lines begin that dora's libraries write to the output of a node."""


@dataclass(frozen=True)
class Word:
    """One line of a node."""

    at_us: int  # CLOCK_REALTIME µs; of the last one, if it came several times
    node: str
    text: str
    times: int = 1


def choose_last(records: Iterable[Mapping[str, Any]], most: int) -> tuple[Word, ...]:
    """At most `most` lines, oldest first. records: as from journalctl's JSON, newest first."""
    own, dora = _Newest(), _Newest()
    for place, record in enumerate(islice(records, _MOST_READ)):
        if "DORA_EVENT" in record or "DORA_NODE" not in record:
            continue
        word = _word(record)
        if is_told_by_event(word.node.encode(), word.text.encode("utf-8", "replace")):
            continue
        (dora if _is_of_dora(record) else own).add(place, word)
        if len(own.words) > most:
            break
    chosen = [*own.words[:most], *dora.words[: max(most - len(own.words), 0)]]
    return tuple(word for _, word in sorted(chosen, key=lambda one: -one[0]))


def shown_last(words: Iterable[Word], most: int) -> list[Word]:
    """The last `most` lines, with one below each that was repeated: how often it came."""
    found = []
    for word in words:
        again = repeated(word.text, word.times)
        found += [word, *([replace(word, text=again)] if again else [])]
    return found[-most:]


class _Newest:
    """The lines of some kind, newest first, each with its place."""

    def __init__(self) -> None:
        self.words: list[tuple[int, Word]] = []
        self._at: dict[str, int] = {}

    def add(self, place: int, word: Word) -> None:
        """A line that is older than all so far."""
        at = self._at.get(word.node)
        if at is not None:
            newer_place, newer = self.words[at]
            if is_same(newer.text.encode("utf-8", "replace"), word.text.encode("utf-8", "replace")):
                self.words[at] = newer_place, replace(newer, times=newer.times + 1)
                return
        self._at[word.node] = len(self.words)
        self.words.append((place, word))


def _word(record: Mapping[str, Any]) -> Word:
    return Word(
        int(plain_text(record.get("__REALTIME_TIMESTAMP")) or 0),
        plain_text(record.get("DORA_NODE")),
        plain_text(record.get("MESSAGE")),
    )


def _is_of_dora(record: Mapping[str, Any]) -> bool:
    is_program = "DORA_STREAM" not in record
    is_library = plain_text(record.get("DORA_TARGET")).startswith(_LIBRARIES)
    return (is_program or is_library) and plain_text(record.get("PRIORITY")) > str(ERR)

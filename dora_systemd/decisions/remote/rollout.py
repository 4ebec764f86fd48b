"""A release for one host after the other: the verdict on each, and whether to continue. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from dora_systemd.decisions.remote.hosts import NO_PROGRAM, Host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_release_id
from dora_systemd.values import as_mapping

DONE = {"deploy": "deployed", "rollback": "rolled back"}
UNDONE = {"deploy": "rolled back", "rollback": "undone"}
UNCHANGED = "unchanged"
INHIBITED, UNREACHABLE, LOST = "inhibited", "unreachable", "lost"
FAILED, NOT_TRIED = "failed", "not tried"
_RELEASE_WIDTH = 24
"""The width of a release id with a revision of git."""
_UNKNOWN = "-"


class Verdict(NamedTuple):
    """The result of one host."""

    host: str
    word: str  # human-readable
    # release, former: ids, or ""
    release: str = ""
    former: str = ""


class End(Protocol):
    """The end of doractl on a host, see Ended in verbs/remote/talk.py."""

    @property
    def status(self) -> int:
        """The exit status."""

    @property
    def was_in(self) -> bool:
        """Whether doractl had begun there."""


def verdict_of(
    host: Host, verb: str, end: End, error: DoraSystemdError | None, outcome: Mapping[str, Any]
) -> Verdict:
    """The verdict about a host. error: why it was not reached, or is lost. outcome: its object."""
    known = as_mapping(outcome.get("details"))
    texts = [known.get(key) for key in ("release", "former")]
    release, former = (one if isinstance(one, str) and is_release_id(one) else "" for one in texts)
    word = _word(verb, end, error)
    if word == DONE[verb] and outcome.get("result") == UNCHANGED:
        word = UNCHANGED
    return Verdict(host.text, word, release, former)


def _word(verb: str, end: End, error: DoraSystemdError | None) -> str:
    if error is not None:
        if error.code != ExitCode.NO_HOST:
            return FAILED
        return LOST if end.was_in and end.status != NO_PROGRAM else UNREACHABLE
    words = {
        int(ExitCode.OK): DONE[verb],
        int(ExitCode.ROLLED_BACK): UNDONE[verb],
        int(ExitCode.INHIBITED): INHIBITED,
    }
    return words.get(end.status, FAILED)


def verdict_object(
    one: Verdict, verb: str, name: str, problem: Mapping[str, Any] | None
) -> dict[str, Any]:
    """A verdict for JSON, where there is no outcome. problem: the object of an error."""
    return {
        "action": verb,
        "name": name,
        "uuid": None,
        "unit": None,
        "node": None,
        "result": one.word,
        "text": None,
        "details": {},
        "error": problem,
    }


def may_go_on(verb: str, word: str) -> bool:
    """Whether the next hosts may get it: nothing speaks against the release."""
    return word in (DONE[verb], UNCHANGED, INHIBITED, UNREACHABLE)


def worst_status(statuses: Sequence[int]) -> int:
    """The exit status of all: a trial that has failed counts most, else the highest."""
    if ExitCode.ROLLED_BACK in statuses:
        return ExitCode.ROLLED_BACK
    return max(statuses, default=ExitCode.OK)


class Columns:
    """The table, a line at a time. width: of a terminal, None without one."""

    def __init__(self, verb: str, hosts: Sequence[str], width: int | None) -> None:
        ends = (DONE[verb], UNDONE[verb], UNCHANGED)
        words = (*ends, INHIBITED, UNREACHABLE, LOST, FAILED, NOT_TRIED)
        columns = [("HOST", *hosts), ("RESULT", *words), ("RELEASE",), ("BEFORE",)]
        widths = [max(map(len, column)) for column in columns]
        widths[2:] = [_RELEASE_WIDTH] * 2
        # What ran before is the first that a narrow terminal can do without.
        while width is not None and len(widths) > 2 and sum(widths) + 2 * len(widths) > width:
            widths.pop()
        self._widths = widths

    @property
    def header(self) -> str:
        return self._line(("HOST", "RESULT", "RELEASE", "BEFORE"))

    def row(self, one: Verdict) -> str:
        return self._line([cell or _UNKNOWN for cell in one])

    def _line(self, cells: Sequence[str]) -> str:
        shown = zip(cells, self._widths, strict=False)
        return "  ".join(f"{cell:<{width}}" for cell, width in shown).rstrip()

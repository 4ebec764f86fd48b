"""The steps that deploy and rollback report, and the choice of those worth a line. Pure."""

import re
from math import inf
from typing import NamedTuple

from dora_systemd.values import SECOND, counted, format_duration, format_rounded_size

WAIT, COPY, CHECK, BUILD = "wait", "copy", "check", "build"
STOP, START, SOAK, VERDICT, BACK = "stop", "start", "soak", "verdict", "back"
STAGES = (WAIT, COPY, CHECK, BUILD, STOP, START, SOAK, VERDICT, BACK)

_COUNT = r"(\d{1,6})/(\d{1,6}) nodes (ready|running)"
_IN_SECONDS = 600 * SECOND
"""A soak up to this long is shown as "12/30 s"."""

Amount = tuple[int, int]
"""The part of a total that is done, and the total."""


class Step(NamedTuple):
    """A moment of a change of the release."""

    stage: str  # one of STAGES
    text: str  # human-readable
    amount: Amount | None = None  # bytes in COPY, µs in SOAK
    nodes: Amount | None = None  # those that are ready, of all
    passed: bool | None = None  # the verdict
    is_last: bool = False  # of its stage

    @property
    def news(self) -> tuple[object, ...]:
        """The values by which two steps differ that are both worth a line at once."""
        return self.stage, self.nodes, self.is_last


class Pace:
    """Chooses the steps that are shown: what is new at once, what only grows now and then.

    interval: seconds between two steps of the latter kind. silence: seconds after which an
    unchanged step is shown, too, as a sign of life.
    """

    def __init__(self, interval: float, silence: float = inf) -> None:
        self._interval, self._silence = interval, silence
        self._last: Step | None = None
        self._at = 0.0

    def takes(self, step: Step, now: float) -> bool:
        """Whether the step is shown. now: seconds of any clock that only goes forward."""
        last, least = self._last, 0.0
        if last is not None and last.text == step.text:
            least = self._silence
        elif last is not None and last.news == step.news:
            least = self._interval
        if now < self._at + least:
            return False
        self._last, self._at = step, now
        return True


def waiting(text: str) -> Step:
    """Return the step of a change that a lock inhibits. text: which lock."""
    return Step(WAIT, text)


def copying(done: int, total: int) -> Step:
    """Return the step of copying. done: bytes of the project that are in the release."""
    text = f"copying: {format_rounded_size(done)} of {format_rounded_size(total)}"
    return Step(COPY, text, amount=(done, total))


def copied(files: int, total: int, new: int) -> Step:
    """Return the step of a complete copy. new: bytes that no other release has."""
    all_bytes, new_bytes = format_rounded_size(total), format_rounded_size(new)
    text = f"copied: {counted(files, 'file')}, {all_bytes}, {new_bytes} of it new"
    return Step(COPY, text, amount=(total, total), is_last=True)


def checking() -> Step:
    """Return the step that checks the copy as for a start."""
    return Step(CHECK, "checking")


def building(line: str) -> Step:
    """Return the step of a running build. line: the last of its output, "" before the first."""
    return Step(BUILD, f"building: {line}" if line else "building")


def stopping(status: str) -> Step:
    """Return the step that stops the former release. status: STATUS= of its unit."""
    _, comma, left = status.partition("stopping, ")
    return Step(STOP, f"stopping what runs now: {left}" if comma else "stopping what runs now")


def starting(status: str) -> Step:
    """Return the step that starts the new release. status: STATUS= of its unit."""
    return Step(START, f"trial: {status or 'starting'}", nodes=_count(status))


def soaking(status: str, passed: int, soak: int, awaited: str = "") -> Step:
    """The release runs. passed, soak: µs since its nodes were ready, and until the verdict.

    awaited: an output that a node owes, which the verdict waits for.
    """
    passed = min(passed, soak)
    state = status.replace("nodes running", "nodes ready", 1) or "up"
    soaked = f", soak {_soaked(passed, soak)}" if soak else ""
    left = f", waits for {awaited}" if awaited else ""
    is_last = passed == soak and not awaited
    text = f"trial: {state}{soaked}{left}"
    return Step(SOAK, text, (passed, soak), _count(status), is_last=is_last)


def judged(release: str, reason: str) -> Step:
    """The verdict. reason: why it has failed, or ""."""
    words = f"failed: {reason}" if reason else "passed"
    return Step(VERDICT, f"trial of {release}: {words}", passed=not reason)


def going_back(release: str, status: str) -> Step:
    """Return the step that starts the former dataflow. release: its release, or ""."""
    words = f": {status}" if status else ""
    return Step(BACK, f"going back to {release or 'what ran before'}{words}", nodes=_count(status))


def _count(status: str) -> Amount | None:
    match = re.match(_COUNT, status)
    return (int(match[1]), int(match[2])) if match else None


def _soaked(passed: int, soak: int) -> str:
    whole = passed // SECOND
    if soak <= _IN_SECONDS:
        return f"{whole}/{soak / SECOND:g} s"
    return f"{format_duration(whole * SECOND)} of {format_duration(soak)}"

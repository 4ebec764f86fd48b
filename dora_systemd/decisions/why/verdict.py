"""What `doractl why` is told of a dataflow, and what it says about it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.views.dataflows import FAILED, RESTARTING, UP_WORDS
from dora_systemd.decisions.why.lives import Happening


@dataclass(frozen=True)
class Facts:
    """What systemd and the runner know of a dataflow now, beside what the journal has.

    status: a word of `list`. text: STATUS=. failed: nodes that are gone for good, restarting:
    those that wait. result, exit_words: of the unit, in words. now_boot: the id of this boot.
    """

    status: str = ""
    text: str = ""
    failed: Mapping[str, str] = field(default_factory=dict)
    restarting: tuple[str, ...] = ()
    now_boot: str = ""


@dataclass(frozen=True)
class Restart:
    """One restart. owner: "dora" of a node, "systemd" of the whole. reason: what made it."""

    at_us: int
    owner: str
    node: str
    reason: str


@dataclass(frozen=True)
class Verdict:
    """What became of a dataflow.

    status: a word of `list`. summary: what ended and how. now: STATUS= of one that is up.
    node: the one that began it, or "".
    at_us: when that was, began_us: when that life began; CLOCK_REALTIME µs, 0: not known.
    invocation: systemd's id of that life. details: what else is known of the end.
    is_given_up: systemd's limit of starts is used up. is_passing: dora starts the node again by
    itself. starved: nodes downstream. before: how the life before these ended, and when.
    """

    status: str
    cause: Cause = Cause.NONE
    summary: str = ""
    now: str = ""
    node: str = ""
    at_us: int = 0
    began_us: int = 0
    invocation: str = ""
    stopped_by: str = ""
    is_given_up: bool = False
    is_passing: bool = False
    details: Mapping[str, str] = field(default_factory=dict)
    starved: tuple[str, ...] = ()
    restarts: tuple[Restart, ...] = ()
    timeline: tuple[Happening, ...] = ()
    before: str = ""
    before_us: int = 0

    @property
    def is_up(self) -> bool:
        """Whether it runs, or is on its way."""
        return self.status in UP_WORDS

    @property
    def is_failure(self) -> bool:
        """Whether something went wrong that was not mended by itself."""
        if self.status in (FAILED, RESTARTING):
            return True
        return self.is_up and bool(self.node) and not self.is_passing

"""The description that a machine sends to a head that may use it as a member. Pure."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.terminal_text import short_line

MOST_SKEW = 500_000
"""µs between the clocks: dora orders events by them, and refuses more than that."""
_LONGEST = 200
_LAST = 2**63 - 1
"""The last µs that a clock can have."""


@dataclass(frozen=True)
class Facts:
    """The description of one account on one machine."""

    # doractl, dora: versions, "" for none
    doractl: str
    dora: str
    program: str  # absolute path of doractl
    user: str
    linger: bool  # whether the user's manager outlives a session; True for root
    now: int  # CLOCK_REALTIME, µs

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self))


def parse_facts(text: str) -> Facts:
    """The facts in the last line of an answer. Raises DoraSystemdError (FAILURE)."""
    try:
        found = json.loads(text.strip().splitlines()[-1])
        names = ("doractl", "dora", "program", "user")
        texts = {name: short_line(str(found[name]), _LONGEST) for name in names}
        return Facts(**texts, linger=bool(found["linger"]), now=_clock(found["now"]))
    except (ValueError, TypeError, KeyError, IndexError, RecursionError) as error:
        hint = "both machines need the same version of dora-systemd"
        raise DoraSystemdError("cannot read what the machine says of itself", hint) from error


def _clock(value: object) -> int:
    """JSON has numbers that are infinite, or too large to be compared with others."""
    if type(value) is not int or not 0 <= value <= _LAST:
        raise ValueError(value)
    return value


def problems(here: Facts, there: Facts, skew: int) -> Iterator[tuple[str, str]]:
    """Yield what prevents the machine from being a member, and hints. skew: of its clock, in µs."""
    for program, own, other in (
        ("dora-systemd", here.doractl, there.doractl),
        ("dora", here.dora, there.dora),
    ):
        if not other:
            yield f"it has no {program}", f"install {program} {own} there"
        elif _minor(own) != _minor(other):
            hint = f"install the same version of {program} on both machines"
            yield f"it has {program} {other}, this machine {own}", hint
    if not there.linger:
        reason = f"{there.user} does not linger, so it would end with the session"
        yield reason, f"there, as root: loginctl enable-linger {there.user}"
    if abs(skew) > MOST_SKEW:
        yield f"its clock differs by {abs(skew) / 1e6:.1f} s", "set up systemd-timesyncd on both"


def _minor(version: str) -> list[str]:
    return version.split(".")[:2]


def required(found: Iterator[tuple[str, str]], machine: str) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for the first problem."""
    for reason, hint in found:
        raise bad_input(f"cannot use {machine} as a machine: {reason}", hint)


def summary(facts: Facts, skew: int) -> Mapping[str, str]:
    """Return what is shown of a machine that can be a member."""
    clock = f"{skew / 1000:+.0f} ms"
    return {"dora-systemd": facts.doractl, "dora": facts.dora, "user": facts.user, "clock": clock}

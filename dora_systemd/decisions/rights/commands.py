"""The programs through which a node is executed, each of which sets one thing and goes on.

They are those of util-linux and coreutils: prlimit(1), chrt(1), nice(1), taskset(1), choom(1). What
raises rights is granted by the unit to all of its processes, see decisions/unit/properties.py. So
the other nodes give it up here. They give up hard limits, which no process gets back. An OOM score
adjustment can be lowered again, to what the unit has: the kernel keeps that value for all children.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dora_systemd.decisions.rights.node_rights import (
    MOST_OOM,
    REALTIME,
    NodeRights,
    given_rights,
    is_negative,
)

OTHERS = "*"
"""Stands for all nodes without rights of their own; no node has this id."""
NICE_LIMIT = 20
"""RLIMIT_NICE is this minus the lowest nice value, see getrlimit(2)."""
BEHIND_ESSENTIAL = 500
"""What the others have more than an essential node: as if they used half of the memory more."""
_PROGRAMS = "/usr/bin"


@dataclass(frozen=True)
class Base:
    """What all processes of the unit have: nice value, OOM score adjustment.

    bound: by node, the list of its CPUs, unless a cgroup keeps the node there.
    """

    nice: int = 0
    oom: int = 0
    bound: Mapping[str, str] = field(default_factory=dict)


def rights_commands(rights: Sequence[NodeRights], base: Base) -> dict[str, list[str]]:
    """The words before the program of each node with rights, and of all OTHERS."""
    named = {one.node: one for one in rights}
    known = {node: named.get(node, NodeRights(node)) for node in (*named, *base.bound, OTHERS)}
    found = {node: _words(one, rights, base) for node, one in known.items()}
    return found if any(found.values()) else {}


def format_commands(commands: Mapping[str, Sequence[str]]) -> str:
    """The lines for launcher.pl: a node id, a blank, and the words."""
    return "".join(f"{node} {' '.join(words)}\n" for node, words in commands.items())


def limits_of_others(rights: Sequence[NodeRights]) -> dict[str, int]:
    """The limits that nodes without such a right give up, by the name of prlimit(1)."""
    realtime = dict.fromkeys(("rtprio",) if any(one.priority for one in rights) else (), 0)
    nice = dict.fromkeys(("nice",) if any(is_negative(one.nice or 0) for one in rights) else (), 0)
    return {**realtime, **nice}


def oom_of(one: NodeRights, rights: Sequence[NodeRights], base: Base) -> int:
    """The OOM score adjustment of a node: its own, or a higher one if only others are essential."""
    if one.oom_score_adjust is not None:
        return one.oom_score_adjust
    # What the unit would have without these rights.
    usual = 0 if any(is_negative(one.oom_score_adjust or 0) for one in rights) else base.oom
    is_behind = not one.essential and any(one.essential for one in rights)
    return min(usual + BEHIND_ESSENTIAL * is_behind, MOST_OOM)


def _words(one: NodeRights, rights: Sequence[NodeRights], base: Base) -> list[str]:
    return [
        *_limits(one, rights),
        *_oom(one, rights, base),
        *_bound(base.bound.get(one.node)),
        *_nice(one, base),
        *_scheduling(one.scheduling),
    ]


def _limits(one: NodeRights, rights: Sequence[NodeRights]) -> list[str]:
    own = {"rtprio": one.priority, "nice": NICE_LIMIT - (one.nice or 0) if _favours(one) else 0}
    kept = {name: own[name] for name in limits_of_others(rights)}
    words = [f"--{name}={number}:{number}" for name, number in kept.items()]
    words += ["--memlock=unlimited:unlimited"] if one.lock_memory else []
    return _program("prlimit", *words) if words else []


def _favours(one: NodeRights) -> bool:
    return is_negative(one.nice or 0)


def _oom(one: NodeRights, rights: Sequence[NodeRights], base: Base) -> list[str]:
    wanted = oom_of(one, rights, base)
    return [] if wanted == base.oom else _program("choom", "-n", str(wanted), "--")


def _bound(cpus: str | None) -> list[str]:
    return _program("taskset", "-c", cpus) if cpus else []


def _nice(one: NodeRights, base: Base) -> list[str]:
    more = 0 if one.nice is None else one.nice - base.nice
    return _program("nice", "-n", str(more)) if more else []


def _scheduling(scheduling: str | None) -> list[str]:
    if scheduling is None:
        return []
    policy, _, priority = scheduling.partition(":")
    assert bool(priority) == (policy in REALTIME)
    return _program("chrt", f"--{policy}", priority or "0")


def _program(name: str, *words: str) -> list[str]:
    return [f"{_PROGRAMS}/{name}", *words]


def described(one: NodeRights) -> str:
    """The rights in words, for messages."""
    texts = {True: "", False: "no "}
    return ", ".join(
        f"{texts[value]}{key}" if isinstance(value, bool) else f"{key} {value}"
        for key, value in given_rights(one).items()
    )

"""The rights of single nodes, and the programs that set these rights. Pure.

The programs are those of util-linux and coreutils: prlimit(1), chrt(1), nice(1), taskset(1),
choom(1). Each program sets one right, and executes the next program. The unit grants raised rights
to all of its processes, see decisions/unit/properties.py. So programs for the other nodes take
these rights away: hard limits, which no process gets back. An OOM score adjustment can be lowered
again, to the value of the unit, which the kernel keeps for all children.
"""

import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import bad_input, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted

LOWEST_NICE, HIGHEST_NICE = -20, 19
MOST_OOM = 1000
"""The range of an OOM score adjustment, and of proc_pid_oom_score_adj(5), is from minus this."""
REALTIME = ("fifo", "rr")
_SHARING = ("batch", "idle", "other")
_POLICIES = (*(f"{policy}:PRIORITY" for policy in REALTIME), *_SHARING)
_PRIORITY = r"0*([1-9][0-9]?)"
_INTEGER = r"[-+]?[0-9]{1,4}"


def parse_scheduling(given: str) -> str:
    """A policy of sched(7), with a priority if it is a realtime one. Raises as parse_nice does."""
    policy, colon, priority = given.strip().partition(":")
    if policy in _SHARING and not colon:
        return policy
    number = re.fullmatch(_PRIORITY, priority)
    if policy in REALTIME and number:
        return f"{policy}:{number[1]}"
    hint = f"write {policy}:PRIORITY with 1 to 99, such as {policy}:50"
    if policy not in REALTIME:
        hint = did_you_mean(policy, _SHARING) or f"valid values: {', '.join(_POLICIES)}"
    raise usage_error(f"cannot use {quoted(given)} as scheduling", hint)


def parse_nice(given: str) -> int:
    """A nice value, see nice(1). Raises DoraSystemdError (USAGE)."""
    hint = f"write a number from {LOWEST_NICE}, most important, to {HIGHEST_NICE}"
    return _parse_integer(given, LOWEST_NICE, HIGHEST_NICE, "nice value", hint)


def parse_oom(given: str) -> int:
    """A value for OOMScoreAdjust= of systemd.exec(5). Raises DoraSystemdError (USAGE)."""
    hint = f"write a number from {-MOST_OOM}, never killed, to {MOST_OOM}, killed first"
    return _parse_integer(given, -MOST_OOM, MOST_OOM, "OOM score adjustment", hint)


def _parse_integer(given: str, lowest: int, highest: int, what: str, hint: str) -> int:
    text = given.strip()
    if not re.fullmatch(_INTEGER, text) or not lowest <= int(text) <= highest:
        raise usage_error(f"cannot use {quoted(given)} as {what}", hint)
    return int(text)


def is_realtime(scheduling: str) -> bool:
    """Whether it comes before all processes without a realtime policy."""
    return scheduling.partition(":")[0] in REALTIME


def is_negative(value: int) -> bool:
    """Whether it favours the node over other processes of the machine."""
    return value < 0


RAISES: Mapping[str, Callable[[Any], bool]] = {
    "scheduling": is_realtime,
    "nice": is_negative,
    "lock_memory": bool,
    "oom_score_adjust": is_negative,
    "essential": lambda _: False,
}
"""By key of each right of a node, whether a value gives the node more than its user has."""


class NodeRights(NamedTuple):
    """The rights of one node; None: not given, so as the other nodes.

    The fields are the keys of RAISES.
    """

    node: str
    scheduling: str | None = None  # as parse_scheduling() returns it
    nice: int | None = None
    lock_memory: bool | None = None  # it may lock all of its memory
    oom_score_adjust: int | None = None
    essential: bool | None = None  # its final failure ends the dataflow

    @property
    def priority(self) -> int:
        """The realtime priority of the node, 0 without one."""
        policy, _, priority = (self.scheduling or "").partition(":")
        return int(priority) if policy in REALTIME else 0


def given_rights(rights: NodeRights) -> dict[str, Any]:
    """The values that are given, by key."""
    return {key: value for key in RAISES if (value := getattr(rights, key)) is not None}


@lru_cache(maxsize=4)
def rights_of(options: RunnerOptions) -> tuple[NodeRights, ...]:
    """The rights of single nodes. Raises DoraSystemdError."""
    named = dict.fromkeys(one.node for one in options.settings if one.node and one.key in RAISES)
    found = {key: options.by_node(key) for key in RAISES} if named else {}
    return tuple(
        NodeRights(node, **{key: values[node] for key, values in found.items() if node in values})
        for node in named
    )


def essential_nodes(options: RunnerOptions) -> tuple[str, ...]:
    """The nodes whose final failure ends the dataflow. Raises DoraSystemdError."""
    return tuple(node for node, value in options.by_node("essential").items() if value)


def has_process_rights(rights: Iterable[NodeRights]) -> bool:
    """Whether a program has to set something for a node before it runs."""
    return any(given_rights(one).keys() - {"essential", "oom_score_adjust"} for one in rights)


def check_rights_nodes(rights: Iterable[NodeRights], launched: Container[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for rights of a node that cannot have them.

    launched: nodes that our launcher starts, which sets their rights.
    """
    more = (one.node for one in rights if given_rights(one).keys() - {"essential"})
    check_launched("cannot give rights to", more, launched)


def check_launched(problem: str, nodes: Iterable[str], launched: Container[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for the first of `nodes` that something else starts.

    problem: the text before "the node", as in names.check_known().
    """
    for node in nodes:
        if node not in launched:
            hint = "what starts a dynamic or ROS 2 node gives it its rights"
            raise bad_input(f"{problem} the node {quoted(node)}: something else starts it", hint)


OTHERS = "*"
"""The id for all nodes without rights of their own, which no node has."""
NICE_LIMIT = 20
"""RLIMIT_NICE is this minus the lowest nice value, see getrlimit(2)."""
BEHIND_ESSENTIAL = 500
"""What the others have more than an essential node: as if they used half of the memory more."""
_PROGRAMS = "/usr/bin"


class Base(NamedTuple):
    """The rights of all processes of the unit: nice value, OOM score adjustment."""

    nice: int = 0
    oom: int = 0
    # by node, the list of its CPUs, unless a cgroup keeps the node there
    bound: Mapping[str, str] = MappingProxyType({})


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
    own = {
        "rtprio": one.priority,
        "nice": NICE_LIMIT - (one.nice or 0) if is_negative(one.nice or 0) else 0,
    }
    kept = {name: own[name] for name in limits_of_others(rights)}
    words = [f"--{name}={number}:{number}" for name, number in kept.items()]
    words += ["--memlock=unlimited:unlimited"] if one.lock_memory else []
    return _program("prlimit", *words) if words else []


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

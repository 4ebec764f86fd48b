"""The findings of `doractl doctor`, a line each with a remedy: journal, real time, CPUs. Pure."""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

from dora_systemd.terminal_text import wrapped


class State(StrEnum):
    """The severity. Only a problem keeps dataflows from working."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True)
class Finding:
    """One finding."""

    topic: str
    state: State
    text: str
    remedy: str = ""  # a command or a sentence, "" if everything is fine


def has_problem(findings: Sequence[Finding]) -> bool:
    """Whether a finding keeps dataflows from working."""
    return any(one.state is State.PROBLEM for one in findings)


def format_findings(findings: Sequence[Finding], width: int | None = None) -> str:
    """A line for each finding, and the remedy on the next line; wrapped to `width` columns."""
    longest = max(len(one.topic) for one in findings)
    lines = []
    for one in findings:
        lines.append((longest + 11, f"{one.state:<7}  {one.topic:<{longest}}  {one.text}"))
        if one.remedy:
            lines.append((longest + 14, f"{'':<{longest + 11}}-> {one.remedy}"))
    if width is None:
        return "\n".join(line for _, line in lines)
    return "\n".join(piece for indent, line in lines for piece in wrapped(line, width, indent))


def finding_values(one: Finding) -> dict[str, str | None]:
    """The finding for JSON."""
    return {
        "topic": one.topic,
        "state": one.state,
        "text": one.text,
        "remedy": one.remedy or None,
    }


_JOURNAL = "journal"
_NEVER, _MEMORY, _DEFAULT = "none", "volatile", "auto"
_WORDS = (_NEVER, _MEMORY, _DEFAULT, "persistent")
_KEEP = (
    "as root: set Storage=persistent in journald.conf(5), then systemctl restart systemd-journald"
)


class Place(StrEnum):
    """The storage to which journald has written since its start."""

    DISK = "disk"
    MEMORY = "memory"
    NOWHERE = "nowhere"
    STOPPED = "stopped"
    """The unit does not run."""
    UNKNOWN = "unknown"


def assigned(config: str, keys: str) -> list[tuple[str, str]]:
    """The keys and values of journald.conf and its drop-ins, in their order. keys: a pattern."""
    return re.findall(rf"^[ \t]*({keys})[ \t]*=[ \t]*(\S*)", config, flags=re.M)


def storage_of(config: str) -> str:
    """The Storage= of journald. config: journald.conf and its drop-ins, in their order."""
    # journald ignores a word that it does not know.
    words = [word for _, word in assigned(config, "Storage") if word in _WORDS]
    return words[-1] if words else _DEFAULT


def judge_journal(place: Place, storage: str) -> Finding:
    """Judge whether records that are written now will exist after a reboot.

    Files alone prove nothing: those of an earlier Storage= stay where they are.
    """
    if place is Place.UNKNOWN:
        text = "whether it survives a reboot is not known without the system's systemd"
        return Finding(_JOURNAL, State.NOTE, text)
    if place is Place.STOPPED:
        text = "systemd-journald does not run: no line is kept"
        remedy = "as root: systemctl start systemd-journald; systemctl unmask it if it is masked"
        return Finding(_JOURNAL, State.WARNING, text, remedy)
    if place is Place.NOWHERE:
        return _kept_nowhere(storage)
    if place is Place.MEMORY:
        text = "it is kept in memory and lost at a reboot"
        return Finding(_JOURNAL, State.WARNING, text, _way_to_disk(storage))
    if storage in (_NEVER, _MEMORY):
        loss = "keeps nothing" if storage == _NEVER else "keeps it in memory only"
        text = f"with Storage={storage}, systemd-journald {loss} once it is restarted"
        return Finding(_JOURNAL, State.WARNING, text, _KEEP)
    return Finding(_JOURNAL, State.OK, "it survives a reboot")


def _kept_nowhere(storage: str) -> Finding:
    if storage == _NEVER:
        return Finding(_JOURNAL, State.WARNING, "no line is kept: journald has Storage=none", _KEEP)
    text = "systemd-journald has kept no line since it was started"
    remedy = "as root: systemctl restart systemd-journald; its systemctl status shows errors"
    return Finding(_JOURNAL, State.WARNING, text, remedy)


def _way_to_disk(storage: str) -> str:
    if storage in (_NEVER, _MEMORY):
        return _KEEP
    if storage == _DEFAULT:
        return "as root: mkdir -p /var/log/journal and systemctl restart systemd-journald"
    return "as root: journalctl --flush; if that changes nothing, can /var/log/journal be written?"


_REAL_TIME = "real time"
_REFUSED = "nodes with scheduling fifo or rr cannot start"
_BEST_GOVERNOR = "performance"


@dataclass(frozen=True)
class RealTime:
    """The facts that decide about real time on this machine."""

    # whether CONFIG_RT_GROUP_SCHED of the kernel keeps realtime from the group of a node, whatever
    # root may have in its own; None: not known
    has_groups: bool | None = None
    # whether root could have a realtime priority; None: nobody tried, or not as root
    is_granted: bool | None = None
    can_raise: bool | None = None  # whether root could have higher limits; None as for is_granted
    isolated: str = ""  # list of isolated CPUs, or ""
    governors: tuple[str, ...] = ()  # of the CPU frequency, without double ones


def judge_real_time(facts: RealTime) -> Iterator[Finding]:
    """Judge what would prevent or slow down a node with a realtime priority."""
    yield _scheduling(facts)
    if facts.can_raise is False:
        text = "not even root can raise limits: no lock_memory, no nice or OOM score below 0"
        remedy = "a container needs CAP_SYS_RESOURCE for it"
        yield Finding("rights", State.NOTE, text, remedy)
    if facts.isolated:
        text = f"cpus {facts.isolated} run only what is bound to them"
        remedy = "bind a node: cpus below nodes: in its settings, see dora-systemd.yml(5)"
        yield Finding("isolated", State.NOTE, text, remedy)
    slow = [one for one in facts.governors if one != _BEST_GOVERNOR]
    if slow:
        text = f"the CPU frequency follows the load ({', '.join(slow)}): reactions may be late"
        remedy = f"as root: cpupower frequency-set -g {_BEST_GOVERNOR}"
        yield Finding("governor", State.NOTE, text, remedy)


def _scheduling(facts: RealTime) -> Finding:
    if facts.can_raise is False:  # the limit of the unit stays 0
        text = f"not even root can raise the limit of realtime priorities: {_REFUSED}"
        return Finding(_REAL_TIME, State.NOTE, text, "a container needs CAP_SYS_RESOURCE for it")
    if facts.has_groups:
        text = f"the kernel has CONFIG_RT_GROUP_SCHED: {_REFUSED}"
        remedy = "boot with rt_group_sched=0 (Linux 6.16 and newer), or use another kernel"
        return Finding(_REAL_TIME, State.NOTE, text, remedy)
    if facts.is_granted is False:
        text = f"this machine refuses realtime scheduling even to root: {_REFUSED}"
        return Finding(_REAL_TIME, State.NOTE, text, "a container needs CAP_SYS_NICE for it")
    return Finding(_REAL_TIME, State.OK, "nodes can have realtime scheduling, if root gives it")


def judge_cpuset(available: Collection[str], is_user: bool) -> Finding:
    """Whether the cgroup keeps a node on its CPUs. available: the controllers of the manager."""
    if "cpuset" in available:
        return Finding("cpuset", State.OK, "nodes stay on the CPUs of cpus:")
    text = "no cpuset controller: a node with cpus: can move itself to others"
    remedy = "the kernel or the container does not provide it"
    if is_user:
        delegated = "cpu cpuset memory pids io"
        remedy = f"as root: systemctl edit user@.service, [Service] Delegate={delegated}"
    return Finding("cpuset", State.NOTE, text, remedy)

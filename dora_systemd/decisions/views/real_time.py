"""Findings of `doractl doctor` about real time and the CPUs of single nodes. Pure."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from dora_systemd.decisions.views.findings import Finding, State

TOPIC = "real time"
_REFUSED = "nodes with scheduling fifo or rr cannot start"
_BEST_GOVERNOR = "performance"


@dataclass(frozen=True)
class RealTime:
    """What decides about real time on this machine.

    has_groups: whether CONFIG_RT_GROUP_SCHED of the kernel keeps realtime from the group of a node,
    whatever root may have in its own; None: not known. is_granted: whether root could have a
    realtime priority; None: nobody tried, or not as root. can_raise: the same for higher limits.
    isolated: list of isolated CPUs, or "". governors: of the CPU frequency, without double ones.
    """

    has_groups: bool | None = None
    is_granted: bool | None = None
    can_raise: bool | None = None
    isolated: str = ""
    governors: tuple[str, ...] = ()


def judge_real_time(facts: RealTime) -> Iterator[Finding]:
    """What a node with a realtime priority would meet, and what would slow it down."""
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
        return Finding(TOPIC, State.NOTE, text, "a container needs CAP_SYS_RESOURCE for it")
    if facts.has_groups:
        text = f"the kernel has CONFIG_RT_GROUP_SCHED: {_REFUSED}"
        remedy = "boot with rt_group_sched=0 (Linux 6.16 and newer), or use another kernel"
        return Finding(TOPIC, State.NOTE, text, remedy)
    if facts.is_granted is False:
        text = f"this machine refuses realtime scheduling even to root: {_REFUSED}"
        return Finding(TOPIC, State.NOTE, text, "a container needs CAP_SYS_NICE for it")
    return Finding(TOPIC, State.OK, "nodes can have realtime scheduling, if root gives it")


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

"""Turns facts into findings of `doractl doctor`. Pure; verbs/doctor.py collects the facts."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.views.findings import Finding, State, assigned
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import format_duration, parse_duration

CONTROLLERS = {"cpu": "CPU", "memory": "memory", "pids": "tasks", "io": "I/O"}
"""Controllers that limits need, see systemd.resource-control(5)."""

DORA_PORTS = {
    6013: "the dora command of 1.0 and newer",
    53290: "the dora command before 1.0",
}
"""Default ports of a coordinator, and the dora versions that use them."""

_CELL = r"/dora-[^/]+\.service(/|$)"
_ENGINES = ("coordinator", "daemon")
_MAX_COMMAND = 80
_COUNTS_HUGE_PAGES = "memory_hugetlb_accounting"
_RATE_DEFAULTS = {"RateLimitIntervalSec": "30s", "RateLimitBurst": "10000"}


@dataclass(frozen=True)
class Process:
    """One process."""

    pid: int
    parent: int
    command: tuple[str, ...]
    group: str = ""  # its cgroup
    is_node: bool = False  # started by dora's daemon, or by such a process

    @property
    def engine(self) -> str:
        """ "coordinator" or "daemon" for dora's own processes, else ""."""
        words = list(self.command[:4])
        programs = (n for n, word in enumerate(words[:3]) if word.rpartition("/")[2] == "dora")
        verbs = (words[n + 1] for n in programs if n + 1 < len(words))
        return next((verb for verb in verbs if verb in _ENGINES), "")

    @property
    def is_in_cell(self) -> bool:
        """Whether the process is part of a supervised dataflow, in any manager."""
        return bool(re.search(_CELL, self.group))

    def __str__(self) -> str:
        shown = " ".join(self.command)
        cut = shown if len(shown) <= _MAX_COMMAND else f"{shown[: _MAX_COMMAND - 3]}..."
        return f"process {self.pid} ({cut})"


def judge_systemd(version: str) -> Finding:
    """Whether this version of systemd supports all properties that a dataflow may need."""
    # Imported late: it has all properties, and verbs that read processes judge no systemd.
    from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION, lacking

    number = _number(version) or MIN_VERSION
    if number < MIN_VERSION:
        text = f"version {version} is too old"
        return Finding("systemd", State.PROBLEM, text, f"upgrade to {MIN_VERSION} or newer")
    if missing := lacking(number):
        text = f"version {version} lacks {len(missing)} properties, see the end"
        remedy = "dataflows run; such a setting is left out with a warning"
        return Finding("systemd", State.NOTE, text, remedy)
    return Finding("systemd", State.OK, f"version {version}")


def judge_properties(version: str) -> Iterator[Finding]:
    """Name the properties that this version of systemd lacks; "" for a systemd that is not there.

    They would fill the screen, so they have a finding of their own, which is the last one.
    """
    from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION, lacking

    number = _number(version) or MIN_VERSION
    missing = lacking(number) if version and number >= MIN_VERSION else ()
    if missing:
        text = f"systemd {version} lacks {', '.join(missing)}"
        yield Finding("properties", State.NOTE, text)


def _number(version: str) -> int:
    match = re.match(r"\d+", version)
    return int(match[0]) if match else 0


def judge_controllers(available: Collection[str], is_user: bool) -> Finding:
    """Whether limits would be enforced."""
    missing = [what for name, what in CONTROLLERS.items() if name not in available]
    if not missing:
        return Finding("cgroup", State.OK, f"v2, with {', '.join(CONTROLLERS)}")
    text = f"v2, but systemd has no controller for {', '.join(missing)}: no limits of that"
    remedy = "the kernel or the container does not provide it"
    if is_user:
        remedy = "as root: systemctl edit user@.service, [Service] Delegate=cpu memory pids io"
    # The admin decides what a user's manager gets; without I/O is the default of distributions.
    state = State.NOTE if is_user and missing == [CONTROLLERS["io"]] else State.WARNING
    return Finding("cgroup", state, text, remedy)


def judge_huge_pages(mounts: str, reserved: str) -> Iterator[Finding]:
    """Report that huge pages count against memory limits, as they do since systemd 259.

    mounts: the content of /proc/self/mounts. reserved: that of /proc/sys/vm/nr_hugepages.
    """
    table = [line.split() for line in mounts.splitlines()]
    options = [words[3].split(",") for words in table if words[2:3] == ["cgroup2"]]
    if reserved.strip() not in ("", "0") and any(_COUNTS_HUGE_PAGES in one for one in options):
        text = "huge pages count against memory limits here, not with systemd before 259"
        remedy = "raise the memory limits of nodes that use huge pages"
        yield Finding("huge pages", State.NOTE, text, remedy)


def judge_rate(config: str, is_user: bool) -> Finding:
    """The rate limit of journald, see journald.conf(5). config: that file and its drop-ins."""
    values = dict(_RATE_DEFAULTS)
    for key, value in assigned(config, r"RateLimit\w+"):
        values[key] = value or _RATE_DEFAULTS.get(key, "")
    interval, burst = values["RateLimitIntervalSec"], values["RateLimitBurst"]
    if interval in ("0", "0s") or burst == "0":
        return Finding("log rate", State.OK, "journald has no rate limit")
    rate = f"{burst} lines in {_duration(interval)}"
    if not is_user:
        return Finding("log rate", State.OK, f"journald's {rate} does not apply to dataflows")
    text = f"journald takes {rate} from all services of a user together and drops the rest"
    remedy = "as root, for more: RateLimitBurst= in journald.conf(5), or use --system"
    return Finding("log rate", State.NOTE, text, remedy)


def judge_port(port: int, owners: Sequence[Process], is_used: bool) -> Finding:
    """Judge what a dora command without doractl would connect to."""
    topic = f"port {port}"
    if not is_used:
        return Finding(topic, State.OK, "free")
    if not owners:
        text = "used by a process of another user"
        return Finding(topic, State.NOTE, text, "run doractl doctor as root to see which")
    text = f"used by {owners[0]}: {DORA_PORTS[port]} talks to that"
    return Finding(topic, State.NOTE, text, "doractl dora NAME -- talks to a dataflow of doractl")


def judge_processes(processes: Sequence[Process]) -> Iterator[Finding]:
    """Processes of dora that run outside of our units."""
    table = {one.pid: one for one in processes}
    free = [one for one in processes if not one.is_in_cell]
    for one in free:
        if one.engine:
            text = f"{one} belongs to no dataflow of doractl"
            remedy = f"if nobody needs it: dora destroy, or kill {one.pid}"
            yield Finding("bare dora", State.NOTE, text, remedy)
    orphans = [one for one in free if one.is_node and not one.engine and _is_orphan(one, table)]
    for one in orphans:
        text = f"{one} is a node whose daemon is gone"
        yield Finding("orphan", State.WARNING, text, f"kill {one.pid}")
    if not orphans and not any(one.engine for one in free):
        yield Finding("bare dora", State.OK, "no daemon, coordinator or node outside of dataflows")


def _is_orphan(process: Process, table: Mapping[int, Process]) -> bool:
    """Whether no daemon of dora is among its parents; a node's children are part of the node."""
    parent = table.get(process.parent)
    if parent is not None and parent.is_node and not parent.engine:
        return False
    seen = {process.pid}
    while parent is not None and parent.pid not in seen:
        if "dora" in " ".join(parent.command[:3]):
            return False
        seen.add(parent.pid)
        parent = table.get(parent.parent)
    return True


def _duration(text: str) -> str:
    try:
        return format_duration(parse_duration(text))
    except DoraSystemdError:
        return text

"""What to do about each cause of an end, and about the last lines of a node. Pure."""

import re
import signal
from collections.abc import Iterable, Mapping, Sequence

from dora_systemd.decisions.cell.exits import EARLY, ExitKind, parse_exit
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.refusal import NOT_EXECUTED
from dora_systemd.decisions.views.dataflows import FROZEN, WAITING
from dora_systemd.decisions.watchdog.judge import LATE, TRIGGERED
from dora_systemd.decisions.why.verdict import Verdict
from dora_systemd.names import release_of
from dora_systemd.values import shell_word

_BY_HAND = "run: doractl restart {name}"
AND_RESTART = f", then {_BY_HAND}"
_AUTOMATIC = f"{_BY_HAND}; --restart-policy on-failure does this automatically"
_OVERLOADED = "run: doractl restart {name}; check whether the machine was overloaded"
_SIZE = "; doractl advise {name} proposes sizes by what was held before"
_MORE_MEMORY = f"doractl set {{name}} --memory-limit SIZE, or limit single nodes (--node){_SIZE}"
_REMEDIES = {
    Cause.NODE_FAILED: f"fix {{node}}{AND_RESTART}",
    Cause.NODE_HUNG: "find out what {node} waited for, or raise health_check_timeout: in its YAML",
    Cause.NODE_WATCHDOG: "find out what {node} waited for, or raise watchdog: in its settings",
    Cause.NODE_SILENT: "find out why {node} sends nothing, or give it more time: "
    "owes: in the settings file",
    Cause.NODE_OUT_OF_MEMORY: "find the leak in {node}, or run: "
    f"doractl set {{name}} --node {{node}}:memory_limit=SIZE{_SIZE}",
    Cause.START_TIMEOUT: "find out why {node} does not call Node(), or raise --start-timeout",
    Cause.REFUSED: "fix {file}, then run: doractl restart {name}",
    Cause.BAD_DATAFLOW: "fix {file}, then run: doractl restart {name}",
    Cause.OTHER_VERSION: "another version of dora-systemd has started it; run: "
    "doractl start --name {name} {file}, or deploy its project again",
    Cause.DAEMON_LOST: _AUTOMATIC,
    Cause.COORDINATOR_LOST: _AUTOMATIC,
    Cause.NO_ANSWER: _OVERLOADED,
    Cause.MACHINE_LOST: _AUTOMATIC,
    Cause.NO_MACHINE: "check that ssh reaches the machine without a password, then run: "
    "doractl restart {name}",
    Cause.MACHINE_REFUSES: "change that on the machine, then run: doractl restart {name}",
    Cause.STOPPED_ON_MACHINE: "run: doractl restart {name}",
    Cause.DIRECTORY_LOST: "run: doractl restart {name}; only systemd may delete files there",
    Cause.RESTARTS_SPENT: "run: doractl restart {name}",
    Cause.RUNNER_BROKEN: "run: doractl restart {name}; please report it, unless the machine "
    "ran out of processes, files or disk space",
    Cause.RUNNER_KILLED: _AUTOMATIC,
    Cause.WATCHDOG: _OVERLOADED,
    Cause.OUT_OF_MEMORY: _MORE_MEMORY,
    Cause.UNIT_FAILED: "systemctl {flag} status {unit} shows what systemd did",
    Cause.TIMEOUT: "raise --start-timeout or --grace-duration",
    Cause.NO_END: "run: doractl start {file}; to start it at every boot, doractl enable {name}",
}
_MEMORY_REMEDIES = {
    "dataflow": _MORE_MEMORY,
    "machine": "the machine is short of memory: limit single nodes "
    f"(--node NODE:memory_limit=SIZE){_SIZE}",
}
"""Remedies by the owner of the exceeded memory limit, unless that is the node."""
_WATCHDOG_REMEDIES = {
    TRIGGERED: "find out why {node} sent WATCHDOG=trigger",
    LATE: "find out what {node} waited for, or raise --start-timeout",
}
"""Remedies by the reason of the watchdog, where a longer watchdog changes nothing."""
_COREDUMPCTL = "; coredumpctl info {pid} shows where it crashed"
_NO_DUMP = "; doractl doctor says why there is no core dump that shows where it crashed"
_SIGNAL_REMEDIES: Mapping[int, str] = {
    signal.SIGKILL: "find out who killed {node}: journalctl -k, or a kill -9 by hand",
    **dict.fromkeys(
        (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL, signal.SIGFPE),
        f"fix {{node}}{_COREDUMPCTL}",
    ),
}
_THAW = "somebody has frozen the unit; run: systemctl {flag} thaw {unit}"
_CALL_DORA = (
    "have {node} call Node() and keep running, or take {node} out of {file} (what only prepares "
    "something is no node), then run: doractl restart {name}"
)
_NO_PROGRAM = (
    "systemctl {flag} status {unit} names its program; if that is gone, doractl start {name} says "
    "how to start it again"
)
_GATHERING = "nothing: it starts when all machines are there; doractl stop {name} gives up"


def remedy_of(verdict: Verdict) -> str:
    """The remedy, with names in braces that the report fills in; "" for none."""
    if verdict.status == FROZEN:
        return _THAW
    if verdict.cause is Cause.MACHINE_LOST and verdict.status == WAITING:
        return _GATHERING
    if verdict.cause in (Cause.NODE_OUT_OF_MEMORY, Cause.OUT_OF_MEMORY):
        owner = verdict.details.get("owner", "")
        return _MEMORY_REMEDIES.get(owner, _REMEDIES[verdict.cause])
    exit = parse_exit(verdict.details.get("exit", ""))
    if exit == EARLY:
        return _CALL_DORA
    if verdict.cause is Cause.NODE_FAILED and exit.kind is ExitKind.SIGNAL:
        return _SIGNAL_REMEDIES.get(exit.number, _REMEDIES[verdict.cause])
    is_lost = verdict.summary == NOT_EXECUTED
    remedy = _NO_PROGRAM if is_lost else _REMEDIES.get(verdict.cause, "")
    if verdict.cause is Cause.NODE_WATCHDOG:
        found = (text for reason, text in _WATCHDOG_REMEDIES.items() if reason in verdict.summary)
        remedy = next(found, remedy)
    has_policy = verdict.policy not in ("", "no")
    return _BY_HAND if remedy == _AUTOMATIC and has_policy else remedy


def about_core_dump(text: str, has_dump: bool, has_stack: bool) -> str:
    """A remedy that mentions a core dump only if the machine keeps one."""
    return text if has_dump else text.replace(_COREDUMPCTL, "" if has_stack else _NO_DUMP)


_MORE = "see dora-systemd-security(7)"
_SIGNS: Sequence[tuple[tuple[str, ...], str]] = (
    (
        ("No module named 'dora'",),
        "its Python has no dora-rs: pip install dora-rs there, or give its environment with --venv",
    ),
    (
        ("/.cache/uv`",),
        "uv cannot write its cache: --property CacheDirectory=NAME --env UV_CACHE_DIR="
        f"/var/cache/NAME gives it one, {_MORE}",
    ),
    (
        ("Read-only file system", "EROFS"),
        "files are read-only in the sandbox: --writable PATH allows one (of a release none: "
        "--property StateDirectory=NAME gives the nodes $STATE_DIRECTORY, which stays), "
        f"{_MORE}",
    ),
    (
        (
            "No such file or directory: '/dev/",
            "No such file or directory: /dev/",
            "can't open camera by index",
        ),
        f"devices are hidden in the sandbox: --device PATH allows one, {_MORE}",
    ),
    (
        (
            "annot open display",
            "ould not connect to display",
            "couldn't connect to display",
            "cannot connect to X server",
            "no display name and no $DISPLAY",
            "DISPLAY environment variable is missing",
        ),
        "nodes have no display: --env DISPLAY=:0 names one, and in system scope --property "
        f"BindReadOnlyPaths=/tmp/.X11-unix shows its socket, {_MORE}",
    ),
    (
        ("No such file or directory: '/tmp/", "No such file or directory: '/var/tmp/"),
        f"/tmp is private in the sandbox: --writable /tmp shares the one of the machine, {_MORE}",
    ),
    (
        ("can't start new thread", "Resource temporarily unavailable"),
        "the limit of processes and threads may be reached: doractl set NAME --tasks-limit N, or "
        "--node NODE:tasks_limit=N, raises it",
    ),
    (
        ("Operation not permitted", "Address family not supported", "EPERM"),
        f"the sandbox may have refused that; try --sandbox none, {_MORE}",
    ),
)
"""Parts of lines of the C library, Python and Rust, the clearest signs first."""


_GONE = r"can't open file '/[^\n]*\[Errno 2\]"
_WAS_THERE = (
    "its file is not where it was: if somebody has replaced or removed its directory since the "
    "start, only a restart of the dataflow finds the new one"
)
_FULL = (
    r"(?:No space left on device|Disk quota exceeded|ENOSPC|EDQUOT)"
    r"(?:[^\n'\"]{0,40}['\"](?P<path>/[^\n'\"]{1,200})['\"])?"
)
"""Many programs report these errors without the path; Python appends the path."""


def known_remedy(lines: Iterable[str], node: str = "the node") -> str:
    """Find the remedy for a node with these last lines, or "" if they match no known error."""
    text = "\n".join(lines)
    if full := re.search(_FULL, text):
        return _space(full["path"], node)
    if re.search(_GONE, text):
        return _WAS_THERE
    return next((help_ for signs, help_ in _SIGNS if any(one in text for one in signs)), "")


def _space(path: str | None, node: str) -> str:
    """The remedy for a full file system. path: of a file that could not be written."""
    if path is None:
        return f"a file system that {node} writes to is full: df shows which one"
    return f"the file system of this file is full: df {shell_word(path)}"


def of_release(text: str, name: str, file: str) -> str:
    """Turn a remedy into that of a dataflow with releases, whose files nobody must change.

    file: the dataflow file, which need not belong to a release.
    """
    fixed = f", then run: doractl deploy --name {name}"
    text = text.replace(f", then run: doractl restart {name}", fixed)
    if release := release_of(file):
        word, inside = shell_word(file), file.partition(f"/{release}/tree/")[2]
        text = text.replace(f"fix {word}", f"fix {inside} in its project")
        text = text.replace(f"doractl start {word}", f"doractl start {name}")
    return text

"""The stack of a node that a signal ended: of its core dump, and of Python. Pure.

systemd-coredump(8) writes the stack of a core dump as the text of its record, Python (see
PYTHONFAULTHANDLER=) writes its own to stderr. The node chooses all names in both texts.
"""

import re
import signal
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.exits import ExitKind, parse_exit
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.why.lives import parse_number, plain_text
from dora_systemd.decisions.why.verdict import Verdict
from dora_systemd.scope import Scope
from dora_systemd.terminal_text import cut
from dora_systemd.values import SECOND

MOST_FRAMES = 10
"""Maximum number of frames of each stack."""
NATIVE, PYTHON = "native", "python"
DUMP_FIELDS = (
    "MESSAGE",
    "COREDUMP_CGROUP",
    "COREDUMP_PID",
    "COREDUMP_SIGNAL",
    "COREDUMP_TIMESTAMP",
)

_DUMPED = "fc2e22bc6ee647b6b90729ab34a250b1"
"""SD_MESSAGE_COREDUMP."""
_WRITERS = (
    r"_SYSTEMD_SLICE=system-systemd\x2dcoredump.slice",
    "_SYSTEMD_UNIT=systemd-coredumpd.service",  # systemd 262, with Linux 6.17
)
"""Only root can start a unit there, and journald itself writes these fields."""

_CORE_SIGNALS = {
    *(signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGILL, signal.SIGFPE),
    *(signal.SIGTRAP, signal.SIGSYS, signal.SIGQUIT),
}
_SHELL = 128
"""A shell and uv exit with this and the number of the signal that ended their child."""
_LONGEST_DUMP = 60 * SECOND
"""Maximum µs between the crash of a child and the end of the node."""
_MOST_READ = 20
"""Frames that are read of a core dump, with those of a signal handler."""
_MOST_TEXT, _MOST_LINE, _MOST_WORD = 64 * 1024, 600, 120


class Frame(NamedTuple):
    """One call, the innermost first."""

    language: str  # NATIVE or PYTHON
    function: str
    place: str  # the library and the offset in that file, or the file and the line

    def __str__(self) -> str:
        return f"{self.function} ({self.place})"


class Crash(NamedTuple):
    """The end of a node by a signal."""

    node: str
    signal: int
    pid: int | None  # None if the signal ended a child of the node, or if that is not recorded
    since_us: int
    until_us: int


def crash_of(verdict: Verdict) -> Crash | None:
    """The crash of the node that failed first; None if no signal with a core dump ended it."""
    details = verdict.details
    exit, pid = parse_exit(details.get("exit", "")), parse_number(details.get("node_pid", ""))
    number = exit.number if exit.kind is ExitKind.SIGNAL else exit.number - _SHELL
    if verdict.cause is Cause.NODE_WATCHDOG:
        number, pid = signal.SIGABRT, None  # each process of the node gets that
    elif exit.kind is not ExitKind.SIGNAL:
        pid = None
    if not verdict.node or number not in _CORE_SIGNALS:
        return None
    since = verdict.began_us if pid else max(verdict.began_us, verdict.at_us - _LONGEST_DUMP)
    return Crash(verdict.node, number, pid, since, verdict.at_us)


def dump_matches(scope: Scope, unit: str) -> list[str]:
    """Matches for the records of systemd-coredump about a unit, which nobody else can write."""
    own = [f"MESSAGE_ID={_DUMPED}", f"COREDUMP_UNIT={unit}"]
    if scope.is_user:
        own[1:] = [f"COREDUMP_USER_UNIT={unit}", f"COREDUMP_UID={scope.uid}"]
    first, second = ([writer, *own] for writer in _WRITERS)
    return [*first, "+", *second]


def find_dump(
    records: Iterable[Mapping[str, Any]], unit: str, crash: Crash
) -> tuple[Frame, ...] | None:
    """The stack of the thread that crashed; None without a record. records: newest first."""
    texts = ({key: plain_text(one.get(key)) for key in DUMP_FIELDS} for one in records)
    found = next((one["MESSAGE"] for one in texts if _is_of(one, unit, crash)), None)
    return None if found is None else dump_frames(found)


def _is_of(record: Mapping[str, str], unit: str, crash: Crash) -> bool:
    pid, number, at_us = (parse_number(record[f"COREDUMP_{key}"][:20]) for key in _NUMBERS)
    # The kernel has the time of a crash in seconds.
    is_then = at_us is not None and crash.since_us - SECOND < at_us <= crash.until_us
    is_there = f"/{unit}/node-{crash.node}/" in f"{record['COREDUMP_CGROUP']}/"
    return is_then and is_there and number == crash.signal and crash.pid in (None, pid)


_NUMBERS = ("PID", "SIGNAL", "TIMESTAMP")
_THREAD = "Stack trace of thread "
_DUMP_FRAME = re.compile(r"#[0-9]{1,4} +0x[0-9a-f]{1,16} ([^ ].*) \(([^()]+ \+ 0x[0-9a-f]{1,16})\)")
_NOT_KNOWN, _UNNAMED = ("", "n/a"), "?"


def dump_frames(text: str) -> tuple[Frame, ...]:
    """The frames in the text of a record: the first thread is the one that crashed."""
    _, _, stack = text[:_MOST_TEXT].partition(_THREAD)
    lines = (one.strip()[:_MOST_LINE] for one in stack.partition(_THREAD)[0].splitlines())
    found = filter(None, map(_DUMP_FRAME.fullmatch, lines))
    return tuple(_frame(NATIVE, one[1], one[2]) for one in islice(found, _MOST_READ))


def _frame(language: str, function: str, place: str) -> Frame:
    name = _UNNAMED if function in _NOT_KNOWN else plain_name(function)
    # Of a path the end is the important part.
    end = place if len(place) <= _MOST_WORD else f"...{place[3 - _MOST_WORD :]}"
    return Frame(language, cut(name, _MOST_WORD), end)


_LENGTH = "[1-9][0-9]{0,2}"
_HASH = "h[0-9a-f]{16}"


def plain_name(symbol: str) -> str:
    """The name of a function of C++ or Rust without its types; other symbols as they are."""
    is_nested = symbol.startswith("_ZN")
    rest = re.sub("^_Z(L|N[rVK]*)?", "", symbol)
    parts: list[str] = []
    while symbol.startswith("_Z") and (length := re.match(_LENGTH, rest)):
        begin, end = length.end(), length.end() + int(length[0])
        parts.append(rest[begin:end])
        rest = rest[end:]
        if not is_nested:
            break
    if not parts or (is_nested and not rest.startswith("E")):
        return symbol
    return "::".join(one for one in parts if not re.fullmatch(_HASH, one)) or symbol


_FATAL = "Fatal Python error: "
_CURRENT = re.compile(r"(Current thread 0x[0-9a-f]+|Stack) (\[.*\] )?\(most recent call first\):$")
_ANY_THREAD = re.compile(r"(Current t|T)hread 0x[0-9a-f]+ .*\(most recent call first\):$")
_C_STACK = re.compile(r"Current thread's C stack trace \(most recent call first\):$")
_CALL = re.compile(r'\s*File ("?)(.{1,400})\1, line ([0-9]{1,9}|\?\?\?) in (.{1,600})')
_C_CALL = re.compile(
    r'\s*Binary file "([^"]{1,400})"(?:, at ([^+ ]{0,300})(\+0x[0-9a-f]+)?)? \[0x[0-9a-f]+\]'
)
_OTHER = ("Extension modules: ", "  <no Python frame>", "Stack (most recent call first):")
_OF_HANDLER = ("_Py_DumpStack", "_Py_DumpExtension", "faulthandler_")


def python_frames(lines: Iterable[str]) -> tuple[Frame, ...]:
    """The frames of the last dump in lines that a node has written, newest first.

    Python 3.14 adds those of C, which are NATIVE.
    """
    dump: list[str] = []
    for line in lines:
        if line.startswith(_FATAL):
            break
        dump.insert(0, line[:_MOST_LINE])
    else:
        return ()
    calls = [_frame(PYTHON, one[4], f"{one[2]}:{one[3]}") for one in _after(dump, _CURRENT, _CALL)]
    native = [
        one for one in _after(dump, _C_STACK, _C_CALL) if not (one[2] or "").startswith(_OF_HANDLER)
    ]
    # Its own signal handler and the kernel's way to that come first, without a name.
    named = next((n for n, one in enumerate(native) if one[2]), 0)
    below = [_frame(NATIVE, one[2] or "", f"{one[1]}{_offset(one[3])}") for one in native[named:]]
    return (*below[:MOST_FRAMES], *calls[:MOST_FRAMES])


def without_handler(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """The frames below the signal handler of Python, which raises the signal again."""
    place = next((n for n, one in enumerate(frames[:3]) if one.function == "raise"), None)
    if place is None:
        return frames
    below = place + 1
    while frames[below:] and frames[below].function.startswith(_OF_HANDLER):
        below += 1
    # By this function of the C library a handler returns.
    is_return = frames[below:] and frames[below].function in (_UNNAMED, "__restore_rt")
    return frames[below + 1 :] if is_return else frames[below:]


def _offset(text: str | None) -> str:
    return f" {text[0]} {text[1:]}" if text else ""


def _after(dump: list[str], title: re.Pattern[str], call: re.Pattern[str]) -> list[re.Match[str]]:
    """The calls below the first line that is this title, up to the next other line."""
    place = next((n for n, line in enumerate(dump) if title.match(line)), len(dump))
    found = []
    for line in dump[place + 1 :]:
        if (match := call.fullmatch(line)) is None:
            break
        found.append(match)
    return found


def is_of_stack(line: str) -> bool:
    """Whether Python has written this line as a part of such a dump, or it is empty."""
    if not line or line.startswith((_FATAL, *_OTHER)):
        return True
    return any(one.match(line) for one in (_ANY_THREAD, _C_STACK, _CALL, _C_CALL))

"""Mutants that no test kills, each with its reason: most of them do what the original does."""

import re
from typing import NamedTuple


class Kept(NamedTuple):
    """Survivors that stay. path, change: patterns of the file, and of "BEFORE -> AFTER"."""

    path: str
    change: str
    reason: str


KEPT = (
    Kept(
        *("", r'encoding="utf-8".* -> (?!.*encoding="utf)'),
        "Python reads UTF-8 in the locale C, and in those of UTF-8; the tests have no other",
    ),
    Kept("", "-> .*[\"']UTF-8[\"']", "Python takes the name of an encoding in any case"),
    Kept(
        *("", r'code\([^)]*("XXreplaceXX"|"REPLACE"|"utf-8", \))'),
        "for bytes that are no UTF-8; where it counts is tested",
    ),
    Kept("trust/sockets", r"IPPROTO_TCP, 1, 0", "an extension that nothing here asks for"),
    Kept("trust/sockets", r"recv\(4097\)", "the kernel answers with far less than 4096 bytes"),
    Kept("trust/files", r"MAX_BYTES \+ 2", "one byte too many shows as well that it is too large"),
    Kept("trust/sight", r"\* 1001", "a thousandth of the time that is left"),
    Kept("trust/terminals", r"TIOCSCTTY, \)", "0 is the argument if none is given, see fcntl"),
    Kept("", r"file=sys\.stderr, flush=False", "Python writes standard error line by line"),
    Kept(
        *("decisions/life", r"handle\.(joined|leave_now)\(.*, None\)"),
        "the handlers of a table take an event, and these two need none",
    ),
    Kept("decisions/life/table", r"keys\(\) < ", "no state handles all events itself"),
    Kept(
        "decisions/why/lives",
        r'NodeRow\(node, (None|"XXXX"), restarts=0\)\)\._replace',
        "the state is set there",
    ),
    Kept("runner/cell/begin", '"XXHOMEXX" not in', "a HOME that is set stays, see with_place()"),
    Kept("runner/cell/boot", r"self\._port = 0 ->", "its readers wait for the thread that sets it"),
    Kept("adapters/logs/held", r"self\._done - lines != ", "it writes again what is noted already"),
    Kept("adapters/logs/jsonl", r"_fd < 1", "0 is standard input"),
    Kept("adapters/logs/jsonl", r"self\._noted = ", "it writes again what is noted already"),
    Kept("adapters/logs/jsonl", r"self\._place = -2", "all numbers below 0 are no descriptor"),
    Kept("adapters/logs/jsonl", r"_read_chunk\(\) > 1", "the rest is read 50 ms later"),
    Kept("adapters/logs/pipes", r"pipe, None, is_flood", "None is no data, as b'' is"),
    Kept("", r"-> .*time\.monotonic\(\) (<|>)= ", "no clock shows that moment"),
    Kept("adapters/logs/pipes", r"\.drained = 1$", "one byte of DRAIN_LIMIT"),
    Kept("adapters/logs/queue", r"max\(len\(stopped\), 2\)", "one lane has no other turn"),
    Kept(
        "decisions/logs/journal_events",
        r"EventKind\(",
        "the table is made before there is a mutant",
    ),
    Kept("decisions/logs/terminal", r"times >= 1:", "once is no repetition, see repeated()"),
    Kept("", r"too_many\(None\)", "the project has no path, as ''"),
    Kept("verbs/releases/build", r"in range\(len\(parts\)\)", "no file has the path ''"),
    Kept(
        *("verbs/releases/change", r"end_killed\(Bus|_end_alone|read_life\(manager, None"),
        "a child does this after a kill: tests/system/deploy/kills.py",
    ),
    Kept(
        *("verbs/releases/change", r'"StatusText", '),
        "without a status nothing is looked for in it",
    ),
    Kept("verbs/releases/files", r'"XXXX"\.join', "a pointer of Git LFS is smaller than a chunk"),
    Kept("verbs/releases", r'"(RELEASE|FORMER|NODES|REASON)": ', "the journal has capital letters"),
    Kept("", r"self\._is_\w+ = False -> .* = None$", "it is only asked whether it is true"),
)


def find_reason(path: str, before: str, after: str) -> str:
    """Return why a survivor stays; "" if it has to be killed."""
    change = f"{before} -> {after}"
    for one in KEPT:
        if re.search(one.path, path) and re.search(one.change, change):
            return one.reason
    return ""

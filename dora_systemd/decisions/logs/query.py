"""The arguments of journalctl(1) for a query.

journalctl finds, filters and formats records quickly. This module selects exactly the records of a
dataflow.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dora_systemd.decisions.logs.journal_events import (
    BUNDLE_WRITTEN,
    END_EVENTS,
    EVENTS,
    GIVEN_UP,
    NOTICE_ENDS,
    REQUESTS,
    ROLLED_BACK,
    STARTED,
    STARTING,
    STOP_ASKED,
    STOPPING,
)
from dora_systemd.errors import usage_error
from dora_systemd.names import SLICE, unit_name
from dora_systemd.scope import Scope

OUTPUTS = ("short", "short-precise", "json", "cat", "export")

# Levels of dora and of syslog(3), with the highest PRIORITY to show.
LEVELS = {
    **{"emerg": 0, "alert": 1, "crit": 2, "err": 3, "error": 3, "warning": 4, "warn": 4},
    **{"notice": 5, "info": 6, "debug": 7, "trace": 7, "stdout": 7},
}

UNIT_STARTING = "7d4958e842da4a758f6c1cdc7b36dcc5"
"""MESSAGE_ID of systemd's record when it begins to start a unit."""

UNIT_STOPPING = "de5b426a63be47a7b6ac3eaac82e2f6f"
"""MESSAGE_ID of systemd's record when it begins to stop a unit, because of a job."""

UNIT_FAILED = "d9b373ed55a64feb8242e02dbe79a49c"
"""MESSAGE_ID of systemd's record when a unit has failed."""

UNIT_ENDS = ("7ad2d189f7e94e70a38c781354912448", UNIT_FAILED)
PROCESS_EXITED = "98e322203f7a4ed290d09fe03c09fe15"
"""MESSAGE_ID of systemd's record when the main process of a unit has ended."""

UNIT_RESTART = "5eb03494b6584870a536b337290809b3"
"""MESSAGE_ID of systemd's record when it restarts a unit automatically."""

UNIT_RESOURCES = "ae8f7b866b0347b9af31fe1c80b127c0"
"""MESSAGE_ID of systemd's record of what a unit has used, which follows its end if that is much."""

ALL_LINES = "all"
"""The value of --lines for all lines, also with --follow."""
_BOOT = r"all|(?:[0-9a-f]{32})?(?:[+-]?[0-9]+)?"
_DURATION = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:ms|s|min|m|h|d|w)"


@dataclass(frozen=True)
class LogQuery:
    """The records to show, their order and form. "" and (): no restriction."""

    scope: Scope
    name: str = ""
    uuid: str = ""
    nodes: tuple[str, ...] = ()  # "" stands for the records of the dataflow itself
    invocation: str = ""  # of systemd, one life of the unit
    run: str = ""  # dora's id of one run
    is_events: bool = False
    level: str = ""
    # by node, instead of `level`; needs `nodes`
    levels: Mapping[str, str] = field(default_factory=dict)
    boot: str = ""  # as in journalctl(1)
    # since, until: as in systemd.time(7), or a duration, which means that long ago
    since: str = ""
    until: str = ""
    grep: str = ""
    tail: str = ""  # number of last records, or ALL_LINES
    is_follow: bool = False
    is_reverse: bool = False
    is_quiet: bool = False
    want_unprintable: bool = False
    output: str = "short"
    cursor_file: str = ""  # begin after the record in this file, and write the last one to it

    @property
    def is_counted(self) -> bool:
        """Whether only some of the last records are wanted."""
        return self.tail not in ("", ALL_LINES)

    others: tuple["LogQuery", ...] = ()  # more dataflows, of which only the matches count


def parse_level(text: str) -> str:
    """A level, in lower case; raises DoraSystemdError (USAGE) for an unknown one."""
    level = text.lower()
    if level not in LEVELS:
        known = "error, warn, info, debug, trace, stdout; those of syslog are understood too"
        raise usage_error(f"cannot use {text!r} as a level", f"one of {known}")
    return level


def is_boot(text: str) -> bool:
    """Whether it can follow `journalctl --boot`: an id, an offset or both, or "all"."""
    return bool(text) and re.fullmatch(_BOOT, text) is not None


def journal_time(text: str) -> str:
    """A point in time for journalctl; dora's `5m` becomes `-5m`."""
    return f"-{text}" if re.fullmatch(_DURATION, text) else text


def journal_timestamp(us: int) -> str:
    """A CLOCK_REALTIME in µs, for journalctl."""
    return f"@{us // 1_000_000}.{us % 1_000_000:06d}"


def scope_matches(scope: Scope, name: str = "") -> list[str]:
    """Matches for fields that journald itself sets: other users' processes cannot forge them."""
    unit = unit_name(name) if name else ""
    if scope.is_user:
        where = f"_SYSTEMD_USER_UNIT={unit}" if unit else f"_SYSTEMD_USER_SLICE={SLICE}"
        return [where, f"_UID={scope.uid}"]
    return [f"_SYSTEMD_UNIT={unit}" if unit else f"_SYSTEMD_SLICE={SLICE}"]


def query_matches(query: LogQuery) -> list[str]:
    """The matches of a query, see "Matches" in journalctl(1)."""
    # Each match costs journalctl time, and the unit implies the dataflow's name.
    base = scope_matches(query.scope, query.name)
    fields = {
        "DORA_DATAFLOW": query.uuid,
        "_SYSTEMD_INVOCATION_ID": query.invocation,
        "DORA_RUN": query.run,
    }
    base += [f"{field}={value}" for field, value in fields.items() if value]
    if query.is_events:
        base += _event_matches()
    terms = [_with_level([*base, *nodes], level) for level, nodes in _node_terms(query)]
    return _either([*terms, *map(query_matches, query.others)])


def _node_terms(query: LogQuery) -> list[tuple[str, list[str]]]:
    """Levels, with the matches of the nodes whose records are shown from that level on."""
    found: dict[tuple[str, bool], list[str]] = {}
    for node in query.nodes:
        match = f"DORA_NODE={node}" if node else f"SYSLOG_IDENTIFIER={query.name}"
        # Matches of different fields exclude each other within a term.
        key = (query.levels.get(node, query.level), bool(node))
        found.setdefault(key, []).append(match)
    return [(level, nodes) for (level, _), nodes in found.items()] or [(query.level, [])]


def _either(terms: Sequence[list[str]]) -> list[str]:
    first, *others = terms
    return [*first, *(match for term in others for match in ("+", *term))]


def end_matches(scope: Scope, name: str) -> list[str]:
    """Matches for systemd's records of the unit's end, which follow all records of its processes.

    7ad2... SD_MESSAGE_UNIT_SUCCESS and d9b3... SD_MESSAGE_UNIT_FAILURE_RESULT, see sd-messages.h.
    """
    return [*_systemd_matches(scope, name), *(f"MESSAGE_ID={one}" for one in UNIT_ENDS)]


def _systemd_matches(scope: Scope, name: str) -> list[str]:
    unit = unit_name(name)
    if scope.is_user:
        return [f"USER_UNIT={unit}", f"_UID={scope.uid}"]
    return [f"UNIT={unit}", "_PID=1"]


def start_matches(scope: Scope, name: str) -> list[str]:
    """Matches for systemd's records of the starts of a unit, also of one that never began."""
    return [*_systemd_matches(scope, name), f"MESSAGE_ID={UNIT_STARTING}"]


def failure_matches(uuids: Sequence[str]) -> list[str]:
    """Matches for the system manager's records of the failures of dataflows."""
    own = [f"DORA_DATAFLOW={uuid}" for uuid in uuids]
    return ["_PID=1", f"MESSAGE_ID={UNIT_FAILED}", *own]


def story_matches(scope: Scope, name: str, uuid: str) -> list[str]:
    """Matches for life events, systemd's records of the unit, and stop requests."""
    dataflow = f"DORA_DATAFLOW={uuid}"
    own = [*scope_matches(scope, name), dataflow, *_event_matches()]
    asked = [dataflow, *_asked_matches(scope, *REQUESTS)]
    return [*own, "+", *_systemd_matches(scope, name), "+", *asked]


def timeline_matches(
    scope: Scope, name: str, uuid: str, events: Sequence[str], requests: Sequence[str]
) -> list[str]:
    """Matches for these life events, systemd's records of lives of the unit, and requests."""
    dataflow = f"DORA_DATAFLOW={uuid}"
    own = [*scope_matches(scope, name), dataflow, *(f"DORA_EVENT={one}" for one in events)]
    ids = (UNIT_STARTING, UNIT_RESTART, UNIT_RESOURCES, *UNIT_ENDS)
    lives = [*_systemd_matches(scope, name), *(f"MESSAGE_ID={one}" for one in ids)]
    asked = [dataflow, *_asked_matches(scope, *requests)]
    return [*own, "+", *lives, "+", *asked]


def bundle_matches(scope: Scope, name: str, uuid: str) -> list[str]:
    """Matches for all records of a dataflow, systemd's of its unit, and requests."""
    asked = [f"DORA_DATAFLOW={uuid}", *_asked_matches(scope, *REQUESTS)]
    return [*scope_matches(scope, name), "+", *_systemd_matches(scope, name), "+", *asked]


def kernel_matches() -> list[str]:
    """Matches for the records of the kernel: journald itself sets _TRANSPORT."""
    return ["_TRANSPORT=kernel"]


def notice_matches(scope: Scope, name: str) -> list[str]:
    """Matches for all that a notice reports, and for the notices that were sent."""
    events = [f"DORA_EVENT={one}" for one in ("dataflow-failed", "machine-lost", GIVEN_UP)]
    asked = _asked_matches(scope, ROLLED_BACK, *NOTICE_ENDS)
    failures = [*_systemd_matches(scope, name), f"MESSAGE_ID={UNIT_FAILED}"]
    own = [*scope_matches(scope, name), *events]
    reported = [*own, "+", *failures, "+", *asked, f"DORA_DATAFLOW_NAME={name}"]
    return [*reported, "+", *kill_matches(scope, name)]


def kill_matches(scope: Scope, name: str) -> list[str]:
    """Matches for ends of processes, for begins of lives, and for requests to stop."""
    ids = [f"MESSAGE_ID={one}" for one in (UNIT_STARTING, UNIT_STOPPING, PROCESS_EXITED)]
    asked = [*_asked_matches(scope, STOP_ASKED), f"DORA_DATAFLOW_NAME={name}"]
    return [*_systemd_matches(scope, name), *ids, "+", *asked]


def sent_matches(scope: Scope, name: str) -> list[str]:
    """Matches for the notices and bundles that were written, which nodes cannot write."""
    return [*_asked_matches(scope, *NOTICE_ENDS), f"DORA_DATAFLOW_NAME={name}"]


def cut_matches(scope: Scope, name: str) -> list[str]:
    """Matches for the beginnings and ends of lives, and for bundles."""
    events = [f"DORA_EVENT={one}" for one in (STARTING, STARTED, STOPPING, *END_EVENTS)]
    bundles = [*_asked_matches(scope, BUNDLE_WRITTEN), f"DORA_DATAFLOW_NAME={name}"]
    return [*scope_matches(scope, name), *events, "+", *end_matches(scope, name), "+", *bundles]


def request_matches(scope: Scope, *events: str) -> list[str]:
    """Matches for requests of root, or of the user, in that scope."""
    return [*_asked_matches(scope, *events), f"DORA_SCOPE={scope.word}"]


def _asked_matches(scope: Scope, *events: str) -> list[str]:
    # journald itself sets _UID.
    found = [f"DORA_EVENT={event}" for event in events]
    return [*found, f"_UID={scope.uid if scope.is_user else 0}"]


def _event_matches() -> list[str]:
    return [f"MESSAGE_ID={kind.message_id}" for kind in EVENTS.values()]


def _with_level(base: list[str], level: str) -> list[str]:
    if level in ("", "trace", "stdout"):
        return base
    if level == "debug":
        # dora's levels debug and trace are both PRIORITY 7.
        return [*_with_level(base, "info"), "+", *base, "PRIORITY=7", "DORA_LEVEL=debug"]
    return base + [f"PRIORITY={number}" for number in range(LEVELS[level] + 1)]


def query_arguments(query: LogQuery) -> list[str]:
    """The arguments of journalctl for a query."""
    options = [f"--output={query.output}"]
    if query.is_quiet or query.cursor_file or query.output not in ("short", "short-precise"):
        options.append("--quiet")  # no line between two boots
    values = {
        "--boot": query.boot,
        "--since": journal_time(query.since),
        "--until": journal_time(query.until),
        "--grep": query.grep,
        "--lines": query.tail,
        "--cursor-file": query.cursor_file,
    }
    flags = {
        "--follow": query.is_follow,
        "--reverse": query.is_reverse,
        "--all": query.want_unprintable,
    }
    options += [f"{option}={value}" for option, value in values.items() if value]
    options += [flag for flag, is_set in flags.items() if is_set]
    return [*options, "--", *query_matches(query)]

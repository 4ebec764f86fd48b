"""What a bundle may contain: lists of what is allowed, and nothing else passes.

A list of what is forbidden never ends: each version has a new place for a secret. So values of
variables, arguments, settings, credentials, addresses of repositories and command lines are not
removed; they are never collected. What nodes have written themselves is kept, and README.txt
announces that.

Records of the journal become a file that systemd-journal-remote(8) reads, see
https://systemd.io/JOURNAL_EXPORT_FORMATS.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.logs.lines import Value, encode_entry
from dora_systemd.decisions.views.findings import Finding, finding_values
from dora_systemd.decisions.views.rows import DataflowRow, Holder
from dora_systemd.decisions.why.report import Report

OF_UNIT = (
    *("LoadState", "ActiveState", "SubState", "UnitFileState", "InvocationID"),
    *("InactiveExitTimestamp", "ActiveEnterTimestamp", "InactiveEnterTimestamp"),
    *("StartLimitBurst", "StartLimitIntervalUSec"),
)
OF_SERVICE = (
    *("Result", "NRestarts", "ExecMainPID", "ExecMainCode", "ExecMainStatus", "StatusErrno"),
    *("ExecMainStartTimestamp", "ExecMainExitTimestamp"),
    *("Type", "User", "Group", "Slice", "ControlGroup", "KillMode", "OOMPolicy"),
    *("Restart", "RestartMode", "RestartUSec"),
    *("TimeoutStartUSec", "TimeoutStopUSec", "WatchdogUSec"),
    *("CPUUsageNSec", "CPUQuotaPerSecUSec", "CPUWeight", "AllowedCPUs"),
    *("MemoryCurrent", "MemoryPeak", "MemoryMin", "MemoryLow", "MemoryHigh", "MemoryMax"),
    *("MemorySwapCurrent", "MemorySwapPeak", "MemorySwapMax", "TasksCurrent", "TasksMax"),
    *("LimitCORE", "LimitMEMLOCK", "LimitNOFILE", "NFileDescriptorStore"),
    *("NoNewPrivileges", "ProtectSystem", "ProtectHome", "PrivateTmp", "PrivateDevices"),
    *("PrivateNetwork", "PrivateUsers", "RestrictRealtime", "RestrictSUIDSGID", "DevicePolicy"),
)
"""Properties of a unit, and of a service: states, times, counts, limits, switches."""
VARIABLES = "Environment"
"""The property of which only the names of variables are kept."""

_FIELDS = {
    *("MESSAGE", "MESSAGE_ID", "PRIORITY", "SYSLOG_IDENTIFIER", "CODE_FILE", "CODE_LINE"),
    *("CODE_FUNC", "SYSLOG_FACILITY"),
    *("UNIT", "USER_UNIT", "INVOCATION_ID", "USER_INVOCATION_ID", "UNIT_RESULT"),
    *("JOB_ID", "JOB_TYPE", "JOB_RESULT", "EXIT_CODE", "EXIT_STATUS", "N_RESTARTS"),
    *("__CURSOR", "__REALTIME_TIMESTAMP", "__MONOTONIC_TIMESTAMP", "_BOOT_ID", "_TRANSPORT"),
    *("_PID", "_UID", "_HOSTNAME", "_SYSTEMD_UNIT", "_SYSTEMD_USER_UNIT", "_SYSTEMD_SLICE"),
    *("_SYSTEMD_INVOCATION_ID", "_SOURCE_REALTIME_TIMESTAMP"),
}
"""Fields of journal records: _CMDLINE, _EXE and those of the environment are not among them."""
_OWN = {
    *("DATAFLOW", "DATAFLOW_NAME", "EVENT", "NODE", "NODES", "NODE_PID", "RUN", "STREAM", "CUT"),
    *("ASKED", "BY", "CAUSE", "COUNT", "DOWNSTREAM", "EXIT", "EXIT_STATUS", "FILE", "FILES"),
    *("FORMER", "HELD", "HOW", "LEVEL", "LIMIT", "MACHINE", "MOST", "OUTPUT", "OWNER", "PAUSE"),
    *("PEAK", "REASON", "RELEASE", "SCOPE", "SENDER", "STATUS", "TARGET", "THEN", "TIMESTAMP"),
    *("UNTIL", "FIELDS_MORE", "HELD_PEAK", "CPU_PEAK", "CPU_LIMIT", "PROGRAM", "CONTAINER"),
    "MAPPED_PEAK",
}
"""Fields that begin with DORA_: DORA_SETTINGS, which has all options of a start, is not here."""
_OF_NODES = "DORA_FIELD_"
"""The beginning of fields that nodes write."""

_TOPICS = {
    *("systemd", "cgroup", "cpuset", "linger", "boot", "units", "left over", "releases"),
    *("versions", "journal", "log rate", "dora", "user", "users", "real time", "rights"),
    *("core dumps", "upgrades", "governor", "isolated"),
}
"""Findings of `doractl doctor` whose text names no command line and no value of a setting."""
_NOT_KEPT = "its text is not kept in a bundle; see doractl doctor"
_KEPT_OF_NODE = (
    *("state", "pid", "restarts", "since_us", "kind", "policy", "max_restarts", "hung", "silent"),
    *("is_ended", "needs", "machine", "asked", "asked_by", "is_held"),
)


def kept_record(record: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a journal record that a bundle may have."""
    return {key: value for key, value in record.items() if is_kept_field(key)}


def is_kept_field(key: str) -> bool:
    """Whether a bundle may have that field of a journal record."""
    is_own = key.startswith("DORA_") and key.removeprefix("DORA_") in _OWN
    return key in _FIELDS or is_own or key.startswith(_OF_NODES)


def kept_properties(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines KEY=VALUE of the properties of a unit; of variables only their names."""
    for key in (*OF_UNIT, *OF_SERVICE):
        if key in values:
            yield f"{key}={_property_text(values[key])}"
    names = sorted(one.partition("=")[0] for one in values.get(VARIABLES) or ())
    yield f"{VARIABLES}={' '.join(names)}"


def _property_text(value: Any) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str | int):
        return str(value)
    is_bytes = all(isinstance(one, int) and 0 <= one < 256 for one in value)
    return bytes(value).hex() if is_bytes else ""


def kept_findings(findings: Iterable[Finding]) -> list[dict[str, str | None]]:
    """The findings of `doractl doctor`: of topics that name command lines only the state."""
    return [
        finding_values(one)
        if one.topic in _TOPICS
        else {**finding_values(one), "text": _NOT_KEPT, "remedy": None}
        for one in findings
    ]


def kept_status(status: CellStatus) -> dict[str, Any]:
    """The live table of a dataflow, without the texts of nodes."""
    return {
        "uuid": status.uuid,
        "run": status.run,
        "stage": status.stage,
        "started_us": status.started_us,
        "ready_us": status.ready_us,
        "version": status.version,
        "lines": {node: one._asdict() for node, one in status.lines.items()},
        "nodes": {node: _kept_node(one) for node, one in status.nodes.items()},
    }


def _kept_node(node: NodeStatus) -> dict[str, Any]:
    kept = {key: value for key, value in node._asdict().items() if key in _KEPT_OF_NODE}
    return {**kept, "exit": str(node.exit)}


def kept_report(report: Report, want_journal: bool) -> Report:
    """The report of `doractl why` without command lines; on request without lines of nodes."""
    inhibitors = tuple(map(_kept_holder, report.inhibitors))
    kept = Report(**{**vars(report), "inhibitors": inhibitors})
    return kept if want_journal else Report(**{**vars(kept), "words": (), "stack": ()})


def kept_row(row: DataflowRow, want_journal: bool) -> DataflowRow:
    """The dataflow without command lines; on request without texts of nodes."""
    inhibitors = tuple(map(_kept_holder, row.inhibitors))
    row = row._replace(inhibitors=inhibitors, options_problem="")
    if want_journal:
        return row
    return row._replace(nodes=tuple(one._replace(text="") for one in row.nodes))


def _kept_holder(holder: Holder) -> Holder:
    return holder._replace(command="")


_KILL = r"(oom-kill:.*|Killed process )"
_PID = r"\bpid=([0-9]+)|Killed process ([0-9]+)"


def is_kill_of(message: str, unit: str, pids: set[str]) -> bool:
    """Whether the kernel reports that it has killed a process of a unit because of memory.

    pids: of processes of the unit that the kernel has named, which gets one more. A record names
    the group, and the next one only the process.
    """
    if not (re.search(_KILL, message) and (found := re.search(_PID, message))):
        return False
    pid = found[1] or found[2]
    if f"/{unit}" in message:
        pids.add(pid)
    return pid in pids


LIVES = 2
"""This life and the last one."""
_ADDRESS = ("__CURSOR", "__REALTIME_TIMESTAMP", "__MONOTONIC_TIMESTAMP", "_BOOT_ID")
_LIFE = ("_SYSTEMD_INVOCATION_ID", "INVOCATION_ID", "USER_INVOCATION_ID")


def export_entry(record: Mapping[str, Any]) -> bytes:
    """A record as an entry. record: of journalctl's JSON, see "json" in journalctl(1)."""
    kept = kept_record(record)
    order = (*(key for key in _ADDRESS if key in kept), *(kept.keys() - {*_ADDRESS}))
    return b"".join(_field(key, kept[key]) for key in order) + b"\n"


def _field(name: str, value: Any) -> bytes:
    return b"".join(encode_entry({name: one}) for one in _values_of(value))


def _values_of(value: Any) -> Iterator[Value]:
    """Yield the values of a field: JSON has a list of bytes for binary ones, null for long ones."""
    if not isinstance(value, list):
        if isinstance(value, str | int):
            yield value
    elif all(isinstance(one, int) and 0 <= one < 256 for one in value):
        yield bytes(value)
    else:
        for one in value:
            yield from _values_of(one)


def of_lives(records: Iterable[Mapping[str, Any]], most: int) -> Iterator[Mapping[str, Any]]:
    """Yield the records of the last LIVES lives, newest first, at most `most`.

    records: of one dataflow and its unit, newest first.
    """
    seen: set[str] = set()
    for count, record in enumerate(records):
        life = next((str(record[key]) for key in _LIFE if record.get(key)), "")
        if life:
            seen.add(life)
        if len(seen) > LIVES or count == most:
            return
        yield record

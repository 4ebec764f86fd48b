"""What may be in a bundle: secrets of all kinds go in, and none comes out."""

import json
import re

from dora_systemd.decisions.bundles.allowlist import (
    LIVES,
    export_entry,
    is_kept_field,
    is_kill_of,
    kept_findings,
    kept_properties,
    kept_record,
    kept_report,
    kept_row,
    kept_status,
    of_lives,
)
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.logs.lines import ExportReader
from dora_systemd.decisions.resources.usage import LineCount
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.views.rows import DataflowRow, Holder
from dora_systemd.decisions.why.last_lines import Word
from dora_systemd.decisions.why.report import Report, Subject, format_report
from dora_systemd.decisions.why.stack import Frame
from dora_systemd.decisions.why.verdict import Verdict
from tests.unit.checkout import CHECKOUT

SECRET = "hunter2"


def test_fields_of_records() -> None:
    record = {
        "MESSAGE": "hello",
        "_CMDLINE": f"runner --env KEY={SECRET}",
        "_EXE": SECRET,
        "DORA_SETTINGS": SECRET,
        "DORA_NODE": "camera",
        "DORA_FIELD_X": "1",
        "ENV_X": SECRET,
        "__REALTIME_TIMESTAMP": "1",
    }
    kept = kept_record(record)
    assert sorted(kept) == [
        *("DORA_FIELD_X", "DORA_NODE", "MESSAGE", "__REALTIME_TIMESTAMP"),
    ]


def test_each_field_of_the_manual_is_kept_or_refused() -> None:
    text = (CHECKOUT / "packaging/man/dora-systemd-logs.7").read_text()
    named = {one for one in re.findall(r"DORA_[A-Z_]+", text) if one != "DORA_"}
    assert {one for one in named if not is_kept_field(one)} == {"DORA_SETTINGS"}


def test_properties_of_the_unit() -> None:
    values = {
        "ActiveState": "failed",
        "NRestarts": 3,
        "NoNewPrivileges": True,
        "InvocationID": [1, 255],
        "ExecStart": [("/bin/x", [SECRET], False)],
        "StatusText": SECRET,
        "LoadCredential": [("token", SECRET)],
        "Environment": [f"KEY={SECRET} and more", "OTHER=1"],
    }
    text = "\n".join(kept_properties(values))
    assert SECRET not in text
    assert text.splitlines() == [
        *("ActiveState=failed", "InvocationID=01ff", "NRestarts=3", "NoNewPrivileges=yes"),
        "Environment=KEY OTHER",
    ]


def test_findings() -> None:
    found = kept_findings(
        [
            Finding("systemd", State.OK, "version 257"),
            Finding("orphan", State.WARNING, f"process 3 (dora --token {SECRET})", "kill 3"),
            Finding("settings", State.PROBLEM, f"cannot use {SECRET}", "write a number"),
        ]
    )
    assert SECRET not in json.dumps(found)
    assert [(one["topic"], one["state"]) for one in found][1:] == [
        ("orphan", "warning"),
        ("settings", "problem"),
    ]
    assert found[0]["text"] == "version 257"


HOLDER = Holder(7, "root", f"sh -c {SECRET}", why="update")


def report() -> Report:
    return Report(
        Subject("u", "robot", "dora-robot.service", "--system"),
        Verdict("Failed", node="camera"),
        (Word(1, "camera", "logged"),),
        inhibitors=(HOLDER,),
        stack=(Frame("python", "main", "a.py:1"),),
    )


def test_the_report_has_no_command_line() -> None:
    kept = kept_report(report(), want_journal=True)
    assert SECRET not in format_report(kept)
    assert "logged" in format_report(kept)
    without = format_report(kept_report(report(), want_journal=False))
    assert "logged" not in without
    assert "a.py" not in without


def test_the_row() -> None:
    node = NodeRow("camera", "running", text="logged")
    row = DataflowRow("u", "robot", "x", "Running", nodes=(node,), inhibitors=(HOLDER,))
    row = row._replace(options_problem=SECRET)
    assert SECRET not in str(kept_row(row, want_journal=True))
    assert kept_row(row, want_journal=True).nodes == (node,)
    assert "logged" not in str(kept_row(row, want_journal=False))


def test_the_live_table() -> None:
    status = CellStatus(
        "u", nodes={"camera": NodeStatus("running", 7)}, lines={"camera": LineCount()}
    )
    found = kept_status(status._replace(text=SECRET, signs={"camera": (SECRET,)}))
    assert SECRET not in json.dumps(found)
    assert found["nodes"]["camera"]["pid"] == 7


KILLS = (
    "oom-kill:constraint=CONSTRAINT_MEMCG,task_memcg=/dora.slice/dora-robot.service/node-a,pid=5",
    "Memory cgroup out of memory: Killed process 5 (python3) total-vm:1kB",
    "oom-kill:constraint=CONSTRAINT_MEMCG,task_memcg=/system.slice/other.service,pid=6",
    "Memory cgroup out of memory: Killed process 6 (python3) total-vm:1kB",
    "usb 1-1: new device",
)


def test_kills_of_the_kernel() -> None:
    pids: set[str] = set()
    found = [is_kill_of(one, "dora-robot.service", pids) for one in KILLS]
    assert found == [True, True, False, False, False]


def test_the_export_can_be_read() -> None:
    record = {
        "MESSAGE": [104, 105, 10, 255],
        "DORA_NODE": ["a", [98]],
        "PRIORITY": None,
        "__REALTIME_TIMESTAMP": "5",
        "_CMDLINE": SECRET,
    }
    entry = export_entry(record)
    assert entry.startswith(b"__REALTIME_TIMESTAMP=5\n")
    assert entry.count(b"DORA_NODE=") == 2
    (found,) = ExportReader().feed(entry)
    assert found["MESSAGE"] == b"hi\n\xff"
    assert not {"PRIORITY", "_CMDLINE"} & found.keys()


def test_this_life_and_the_last_one() -> None:
    keys = ("_SYSTEMD_INVOCATION_ID", "INVOCATION_ID", "USER_INVOCATION_ID")
    lives = [{keys[n % 3]: f"life {n}"} for n in range(4)]
    records = [one for life in lives for one in (life, {"MESSAGE": "x"}, life)]
    assert len(list(of_lives(records, 100))) == 3 * LIVES
    assert len(list(of_lives(records, 2))) == 2

"""The words with which a failed start ends, from a journal of our own."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.cli.verbs.run.restart import with_last_words
from dora_systemd.decisions.logs.journal_events import EVENTS as KINDS
from dora_systemd.decisions.logs.query import scope_matches
from dora_systemd.decisions.views.outcome import Outcome, outcome_object
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.why import explain, explain_now, newest_failure, words_of_start
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.fakes.programs import make_program

UUID = options().uuid
ORIGIN = {"DORA_DATAFLOW": UUID, "_SYSTEMD_INVOCATION_ID": "1", "_BOOT_ID": "b"}


def record(us: int, node: str, text: str, **fields: str) -> dict[str, Any]:
    named = {"DORA_NODE": node} if node else {}
    return {**ORIGIN, "__REALTIME_TIMESTAMP": str(us), "MESSAGE": text, **named, **fields}


def crash(us: int, node: str, code: int) -> dict[str, Any]:
    exit = f"exit code {code}"
    return record(us, node, "crashed", DORA_EVENT="node-crashed", DORA_EXIT=exit)


EVENTS = [
    record(1, "", "is starting", DORA_EVENT="dataflow-starting"),
    crash(3, "camera", 3),
    crash(9, "detector", 101),
    record(
        9, "", "failed", DORA_EVENT="dataflow-failed", DORA_CAUSE="node-failed",
        DORA_NODES="camera detector", DORA_REASON="node camera: exit code 3",
    ),
]  # fmt: skip
BEFORE = record(0, "detector", "of the start before", DORA_STREAM="stderr")
CAMERA = [record(2, "camera", "no camera there", DORA_STREAM="stderr")]
DETECTOR = [record(n, "detector", f"frame {n}", DORA_STREAM="stderr") for n in range(4, 8)]


def play(patch: pytest.MonkeyPatch, place: Path, camera: list[dict[str, Any]]) -> None:
    """A journalctl that answers with events, the camera's lines, or those of all nodes."""
    answers = {"events": EVENTS, "camera": camera, "all": [BEFORE, *camera, *DETECTOR]}
    for name, records in answers.items():
        lines = [f"{json.dumps(one)}\n" for one in reversed(records)]
        (place / name).write_text("".join(lines))
    make_program(
        place / "journalctl",
        f'cd {place}\ncase "$*" in\n*DORA_EVENT=stop-asked*) cat events;;\n'
        "*DORA_NODE=camera*) cat camera;;\n*_UID=0*) ;;\n*) cat all;;\nesac",
    )
    patch.setenv("PATH", f"{place}:/usr/bin:/bin")


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (CAMERA, ["camera: no camera there"]),
        ([], [f"detector: frame {n}" for n in range(4, 8)]),
    ],
)
def test_a_failed_start_ends_with_the_words_of_the_guilty_node(
    camera: list[dict[str, Any]],
    words: list[str],
    scope: ScopeIn,
    manager: FakeManager,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Those of the others only if it has written nothing, and never those of an earlier start."""
    manager.add(options(), ActiveState="failed", SubState="failed")
    play(monkeypatch, tmp_path, camera)
    assert words_of_start(manager, scope, UUID) == words
    (cell,) = read_cells(manager)
    problem = Outcome.of_error(cell, DoraSystemdError("cannot restart robot"))
    found = outcome_object(with_last_words(manager, scope, problem), "restart")
    assert found["error"]["lines"] == words


def test_nothing_is_known(scope: ScopeIn, manager: FakeManager) -> None:
    assert words_of_start(manager, scope, UUID) == []


def test_the_newest_failure(
    scope: ScopeIn, manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of those that systemd keeps and those that only the journal knows."""
    journal = FakeJournal(monkeypatch, tmp_path)
    manager.add(options("runs"))
    with pytest.raises(DoraSystemdError, match="no dataflow has failed") as caught:
        newest_failure(manager, scope)
    assert caught.value.hint == "known dataflows: runs"
    manager.add(options("kept"), "failed", InactiveEnterTimestamp=5, ExecMainStatus=1)
    assert newest_failure(manager, scope) == UUID
    other = UUID[:-1] + "7"
    journal.write(life_record("dataflow-failed", 9, "old", other, scope, DORA_REASON="it broke"))
    assert newest_failure(manager, scope) == other


class SlowJournal:
    """One whose journald has not written the end when it is read first."""

    def __init__(self, boot: str) -> None:
        self.reads = 0
        self._boot = boot

    def newest(
        self, matches: Sequence[str], _limit: int | None, **more: object
    ) -> Iterator[dict[str, Any]]:
        if more != {"is_whole": True} or "DORA_NODE=camera" in matches:
            return iter(())
        self.reads += 1
        written = EVENTS if self.reads > 2 else EVENTS[:1]
        return iter([{**one, "_BOOT_ID": self._boot} for one in reversed(written)])


def test_an_end_that_journald_has_not_written_yet_is_read_again(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(options(), ActiveState="failed", Result="exit-code")
    journal = SlowJournal(now_boot())
    verdict = explain(manager, scope, "robot", journal).verdict  # type: ignore[arg-type]
    assert verdict.summary.startswith("node camera: exit code 3")
    assert journal.reads == 3


PLACE = "/dora.slice/dora-robot.service/node-camera"
DUMP = {
    "_SYSTEMD_SLICE": r"system-systemd\x2dcoredump.slice",
    "MESSAGE_ID": "fc2e22bc6ee647b6b90729ab34a250b1",
    "MESSAGE": "dumped core.\n\nStack trace of thread 7:\n#0  0x01 grab (libgrab.so + 0x9)\n",
    **{"COREDUMP_PID": "7", "COREDUMP_SIGNAL": "11", "COREDUMP_TIMESTAMP": "0"},
    **{"COREDUMP_CGROUP": PLACE},
}
PYTHON_DUMP = (
    "Fatal Python error: Segmentation fault",
    "",
    "Current thread 0x0001 (most recent call first):",
    '  File "/home/camera.py", line 12 in read',
)


def crashed(journal: FakeJournal, scope: Scope, **dump: str) -> None:
    """A journal with the crash of a node."""
    by_scope = {"COREDUMP_USER_UNIT" if scope.is_user else "COREDUMP_UNIT": "dora-robot.service"}
    by_scope |= {"COREDUMP_UID": str(scope.uid)} if scope.is_user else {}
    own = dict(one.split("=", 1) for one in scope_matches(scope, "robot"))
    pid = {"DORA_NODE_PID": "7"}
    end = {"DORA_EVENT": "node-crashed", "DORA_EXIT": "signal SIGSEGV", **pid}
    lines = [
        record(2 + n, "camera", text, DORA_STREAM="stderr", **pid)
        for n, text in enumerate(("looking for a camera", *PYTHON_DUMP))
    ]
    failed = {**EVENTS[-1], "DORA_NODES": "camera", "DORA_REASON": "node camera: signal SIGSEGV"}
    story = [EVENTS[0], *lines, record(9, "camera", "crashed", **end), failed]
    ids = {name: {"MESSAGE_ID": kind.message_id} for name, kind in KINDS.items()}
    mine = [{**own, **one, **ids.get(one.get("DORA_EVENT", ""), {})} for one in story]
    journal.write({**DUMP, **by_scope, **dump}, *reversed(mine))


@pytest.mark.parametrize(
    ("dump", "functions"),
    [
        ({}, ["grab", "read"]),
        # Anybody can write the other fields.
        ({"_SYSTEMD_SLICE": "user.slice"}, ["read"]),
        ({"COREDUMP_PID": "8"}, ["read"]),
    ],
)
def test_a_crash_has_its_stack(
    dump: dict[str, str],
    functions: list[str],
    scope: ScopeIn,
    manager: FakeManager,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    crashed(FakeJournal(monkeypatch, tmp_path), scope, **dump)
    manager.add(options(), ActiveState="failed", SubState="failed")
    report = explain(manager, scope, "robot", JournalReader())
    assert [one.function for one in report.stack] == functions
    assert [one.text for one in report.words] == ["looking for a camera"]


def test_who_had_the_cpu_only_now(
    scope: ScopeIn, manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Not in a report for the gateway or a notice, which must not wait."""
    group = fake_cgroups(monkeypatch, tmp_path) / "dora-robot.service"
    (group / "node-camera").mkdir(parents=True)
    (group / "node-camera/cpu.max").write_text("50000 100000\n")
    (group / "node-camera/cpu.stat").write_text("usage_usec 9\nnr_periods 10\nnr_throttled 6\n")
    (group / "node-camera/cpu.pressure").write_text("some avg10=0 avg60=0.0 avg300=0 total=1\n")
    manager.add(options(), ControlGroup="/dora-robot.service")
    journal = FakeJournal(monkeypatch, tmp_path)
    journal.write(life_record("dataflow-started", 9, "robot", UUID, scope))
    report = explain_now(manager, scope, "robot", JournalReader())
    assert [(one.node, one.throttled) for one in report.waits] == [("camera", 60.0)]
    assert explain(manager, scope, "robot", JournalReader()).waits == ()

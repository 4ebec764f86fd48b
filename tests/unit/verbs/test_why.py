"""The words with which a failed start ends, from a journal of our own."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.why import explain, newest_failure, words_of_start
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
CAMERA = [record(2, "camera", "no camera there", DORA_STREAM="stderr")]
DETECTOR = [record(n, "detector", f"frame {n}", DORA_STREAM="stderr") for n in range(4, 8)]


def play(patch: pytest.MonkeyPatch, place: Path, camera: list[dict[str, Any]]) -> None:
    """A journalctl that answers with events, the camera's lines, or those of all nodes."""
    answers = {"events": EVENTS, "camera": camera, "all": [*camera, *DETECTOR]}
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
    """Those of the others only if it has written nothing."""
    manager.add(options(), ActiveState="failed", SubState="failed")
    play(monkeypatch, tmp_path, camera)
    assert words_of_start(manager, scope, UUID) == words


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

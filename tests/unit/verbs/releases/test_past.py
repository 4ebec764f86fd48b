"""What deploy and rollback write to the history, and what they and others read in it."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import HISTORY, Store, locked
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.releases.past import FAILED, INTERRUPTED, REPLACED, ROLLED_BACK
from dora_systemd.decisions.views.objects import switch_object
from dora_systemd.decisions.views.releases import (
    format_history,
    format_releases,
    release_object,
)
from dora_systemd.decisions.why.report import format_report
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.deploy import prune
from dora_systemd.verbs.releases.listing import read_history, read_releases, store_of
from dora_systemd.verbs.releases.rollback import roll_back
from dora_systemd.verbs.releases.trial import (
    KILLED,
    Standing,
    note_fault,
    note_run,
    read_past,
    read_standing,
)
from dora_systemd.verbs.why import explain
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import UNIT, release_options, text_of

A, B, C, D = (f"2026112{day}T220012" for day in range(1, 5))
FAULT = Fault("node a: exit code 1", "a")


class Robot:
    """A dataflow whose releases change without a systemd that starts anything."""

    def __init__(self, manager: FakeManager, scope: Scope, store: Store) -> None:
        self.manager, self.scope, self.store = manager, scope, store

    @property
    def unit_file(self) -> Path:
        """The unit file of what every start runs."""
        return self.manager.etc / "systemd/user" / UNIT

    @property
    def standing(self) -> Standing:
        return read_standing(self.manager, self.scope, UNIT)

    def add(self, release: str) -> None:
        """Put a release into the store."""
        draft = Draft(self.store)
        draft.publish(Manifest(release, "robot", "u", "dataflow.yml", "/srv", "", "", 1), None)
        self.store.write_unit(release, text_of(release))

    def run(self, release: str, by: str = "doractl deploy", is_noted: bool = True) -> None:
        """Commit a release."""
        if not self.store.release(release).exists():
            self.add(release)
        before = self.standing
        self.store.prove(release)
        self.unit_file.parent.mkdir(parents=True, exist_ok=True)
        self.unit_file.write_text(text_of(release))
        path = str(self.unit_file)
        self.manager.add(release_options(release), Transient=False, FragmentPath=path)
        if is_noted:
            note_run(self.store, before, release, by)

    def fail(self, release: str, fault: Fault = FAULT) -> None:
        """Let a release fail its trial."""
        if not self.store.release(release).exists():
            self.add(release)
        note_fault(self.store, self.standing, release, fault, "doractl deploy")

    @property
    def past(self) -> list[tuple[str, str, str]]:
        past = read_past(self.store, self.standing.current)
        return [(one.former, one.release, one.how) for one in past]

    @property
    def states(self) -> list[str]:
        return [one.state for one in read_releases(self.manager, self.scope, ["robot"])][::-1]


@pytest.fixture
def robot(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch, tmp_path: os.PathLike[str]
) -> Robot:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    store = store_of(scope, "robot")
    with locked(store):
        store.path.joinpath("x").touch()  # it is not removed as an empty one
    store.path.joinpath("x").unlink()
    return Robot(manager, scope, store)


@pytest.fixture
def scope() -> Scope:
    return Scope(True, os.getuid())


def test_a_bad_release_its_rollback_and_the_next_one(robot: Robot) -> None:
    for release in (A, B):
        robot.run(release)
    robot.run(A, "doractl rollback")
    robot.fail(C)
    robot.run(D)
    assert robot.past == [
        ("", A, REPLACED),
        (A, B, REPLACED),
        (B, A, ROLLED_BACK),
        (C, A, FAILED),
        (A, D, REPLACED),
    ]
    assert robot.states == ["proved", "rolled-back", "failed", "current"]
    prune(robot.manager, robot.scope, robot.store, 1, D)
    assert [one.id for one in robot.store.known()] == [A, D]


def test_what_is_shown(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    robot.run(A, "doractl rollback")
    robot.fail(C)
    robot.add(D)
    rows = read_releases(robot.manager, robot.scope, ["robot"])
    why = {row.id: row.why for row in rows}
    assert why[A] == ""
    assert why[B].startswith("by ")
    assert why[B].endswith("(doractl rollback)")
    assert why[C] == "node a: exit code 1"
    assert why[D] == "its trial did not end"
    title, *lines = format_releases(rows).splitlines()
    assert title.split()[-1] == "WHY"
    assert lines[1].endswith("node a: exit code 1")
    found = release_object(rows[1])
    assert (found["ended"], found["why"]) == (FAILED, "node a: exit code 1")
    history = read_history(robot.manager, robot.scope, "robot")
    newest = format_history(history).splitlines()[1]
    assert newest.split()[2:5] == [C, A, FAILED]
    assert switch_object("robot", history[0])["reason"] == "node a: exit code 1"


@pytest.mark.parametrize(
    "fault", [Fault("x", is_stop=True), Fault("x", is_outside=True), Fault(KILLED, is_outside=True)]
)
def test_a_trial_that_somebody_ends_says_nothing_of_the_release(robot: Robot, fault: Fault) -> None:
    robot.run(A)
    robot.run(B)
    robot.fail(A, fault)
    assert robot.past[-1] == (A, B, INTERRUPTED)
    assert robot.states == ["proved", "current"]


def test_a_trial_that_was_killed_on_its_way_back_is_noted_once(robot: Robot) -> None:
    robot.run(A)
    robot.fail(B)
    robot.fail(B, Fault(KILLED, is_outside=True))
    assert [how for *_, how in robot.past] == [REPLACED, FAILED]


def test_a_commit_that_was_killed_is_noted_by_whoever_comes_next(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    robot.run(A, is_noted=False)
    assert robot.past[-1] == (B, A, ROLLED_BACK), "the reader sees it"
    assert robot.states == ["current", "rolled-back"]
    robot.run(C)
    text = (robot.store.path / HISTORY).read_text().splitlines()
    assert len(text) == 4, "the writer writes it"
    note_run(robot.store, robot.standing, C, "again")
    assert (robot.store.path / HISTORY).read_text().splitlines() == text


def test_an_unfinished_line(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    path = robot.store.path / HISTORY
    path.write_bytes(path.read_bytes()[:-9])
    assert robot.past[-1] == (A, B, REPLACED)
    robot.run(C)
    assert robot.past == [("", A, REPLACED), (A, B, REPLACED), (B, C, REPLACED)]


def test_no_rollback_by_itself_to_what_is_bad(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    robot.run(A, "doractl rollback")
    with pytest.raises(DoraSystemdError, match="that ran well") as caught:
        roll_back(robot.manager, robot.scope, "robot", None, 0, print)
    assert caught.value.code == ExitCode.NOT_FOUND
    assert "doractl releases robot" in caught.value.hint


def test_a_history_that_nobody_can_read(robot: Robot) -> None:
    """A rollback does not guess; a list and a deploy do without."""
    robot.run(A)
    robot.run(B)
    path = robot.store.path / HISTORY
    path.unlink()
    path.mkdir()
    with pytest.raises(DoraSystemdError, match="history"):
        roll_back(robot.manager, robot.scope, "robot", None, 0, print)
    assert robot.states == ["proved", "current"]
    note_run(robot.store, robot.standing, A, "x")
    prune(robot.manager, robot.scope, robot.store, 1, B)
    assert len(robot.store.known()) == 2


def test_why_has_the_lines_of_a_trial(robot: Robot, tmp_path: Path) -> None:
    """Although another node ran on until doractl stopped it, or an older release runs again."""
    life = {"_SYSTEMD_INVOCATION_ID": "2" * 32, "DORA_NODE": "a"}
    record = {**life, "MESSAGE": "no camera", "DORA_STREAM": "stderr"}
    with pytest.MonkeyPatch.context() as patch:
        journal = FakeJournal(patch, tmp_path / "root")
        line = life_record("x", 5, scope=robot.scope, **record)
        del line["DORA_EVENT"]
        journal.write(line)
        robot.run(A)
        robot.fail(B, FAULT._replace(invocation="2" * 32))
        report = explain(robot.manager, robot.scope, "robot", JournalReader())
    assert [one.text for one in report.words] == ["no camera"]
    text = format_report(report)
    assert f"The last line of a in {B} (all: doractl logs robot --node a):" in text
    assert "fix a, then run: doractl deploy --name robot" in text
    assert f"Undone:   {B} at" in text

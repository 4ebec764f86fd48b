"""What the journal is told of each change of a release, and the words of what is refused."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store, locked
from dora_systemd.adapters.releases.transfer import incoming
from dora_systemd.decisions.releases.manifest import Manifest, Stored
from dora_systemd.decisions.releases.past import REPLACED, Switch
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.deploy import Deployed
from dora_systemd.verbs.releases.forget import find_kept, forget, remove_releases
from dora_systemd.verbs.releases.listing import (
    judge_releases,
    read_history,
    read_releases,
    store_of,
)
from dora_systemd.verbs.releases.rollback import deployed_name, roll_back
from dora_systemd.verbs.releases.source import find_source
from dora_systemd.verbs.releases.trial import read_standing
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager
from tests.unit.fakes.notes import Notes
from tests.unit.fakes.programs import make_program
from tests.unit.verbs.releases.test_trial import (
    NEW,
    OLD,
    UNIT,
    deployed,
    etc,
    release_options,
    store,
    text_of,
    try_new,
)

__all__ = ["store"]

FACTS = ("DORA_EVENT", "DORA_RELEASE", "DORA_FORMER", "DORA_NODES", "DORA_REASON")
COMMITTED = ("release-committed", NEW, OLD, "", "")
STOPPED = ("stop-asked", "", "", "", "")


@pytest.fixture(autouse=True)
def notes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Notes:
    FakeJournal(monkeypatch, tmp_path)
    return Notes(monkeypatch)


def refusal(act: Callable[[], object]) -> DoraSystemdError:
    with pytest.raises(DoraSystemdError) as caught:
        act()
    return caught.value


def test_a_commit(manager: FakeManager, scope: Scope, store: Store, notes: Notes) -> None:
    deployed(manager)
    try_new(manager, scope, store, None)
    assert notes.found(*FACTS) == [STOPPED, COMMITTED]
    own = {"DORA_DATAFLOW": UUID, "DORA_DATAFLOW_NAME": "robot", "SYSLOG_IDENTIFIER": "doractl"}
    assert all(own.items() <= one.items() for one in notes.records)
    assert all(one["DORA_BY"].endswith("(doractl deploy)") for one in notes.records)
    assert notes.records[1]["DORA_SCOPE"] == "system"


def test_a_first_release(manager: FakeManager, scope: Scope, store: Store, notes: Notes) -> None:
    try_new(manager, scope, store, None)
    assert notes.found(*FACTS) == [("release-committed", NEW, "", "", "")]


def test_a_way_back(manager: FakeManager, scope: Scope, store: Store, notes: Notes) -> None:
    deployed(manager)
    fault = Fault("node a: exit code 1", "a", lines=("a: one", "a: two"))
    error = refusal(lambda: try_new(manager, scope, store, fault))
    assert error.message == f"release {NEW} of robot was rolled back: node a: exit code 1"
    assert error.hint == f"{OLD} runs again; doractl why robot shows more"
    assert error.lines == ("a: one", "a: two")
    rolled_back = ("release-rolled-back", NEW, OLD, "a", "node a: exit code 1")
    # The first stop is that of the former release, the second one that of the release on trial.
    assert notes.found(*FACTS) == [STOPPED, STOPPED, rolled_back]
    (switch,) = read_history(manager, scope, "robot")
    assert (switch.former, switch.release, switch.how) == (NEW, OLD, "failed")
    assert (switch.reason, switch.node) == ("node a: exit code 1", "a")
    assert switch.by.endswith("(doractl deploy)")


def test_a_trial_that_somebody_stops(
    manager: FakeManager, scope: Scope, store: Store, notes: Notes
) -> None:
    """The command that stopped the dataflow has recorded who did it."""
    deployed(manager)
    fault = Fault("it was stopped", is_stop=True)
    error = refusal(lambda: try_new(manager, scope, store, fault))
    assert error.hint == "nothing of it runs; doractl why robot shows more"
    assert [one for (one,) in notes.found("DORA_EVENT")] == ["stop-asked", "release-rolled-back"]


def test_a_way_back_that_fails_too(manager: FakeManager, scope: Scope, store: Store) -> None:
    deployed(manager)
    manager.hold(UNIT)  # as a unit with a file

    def break_it(step: Any) -> None:
        if step.stage == "verdict":
            manager.units[UNIT]["ActiveState"] = "failed"

    error = refusal(lambda: try_new(manager, scope, store, Fault("x"), break_it))
    assert error.hint.startswith(f"{OLD} has not started again: failed; ")


def test_what_ran_without_being_enabled_is_named_too(
    manager: FakeManager, scope: Scope, store: Store, notes: Notes
) -> None:
    """While the file of the trial is there, only what was read before it tells what ran."""
    manager.add(release_options(OLD), Transient=False)
    error = refusal(lambda: try_new(manager, scope, store, Fault("x")))
    assert notes.found("DORA_EVENT", "DORA_FORMER")[-1] == ("release-rolled-back", OLD)
    assert error.hint.startswith("nothing of it runs; ")
    (switch,) = store.history()
    assert (switch.former, switch.release) == (NEW, OLD)


@pytest.fixture
def releases(store: Store) -> Store:
    """Two of them, the newer one of one file."""
    store.release(NEW).rmdir()
    for release, content in ((OLD, b""), (NEW, b"12345")):
        draft = Draft(store)
        files = {"a.py": draft.write("a.py", [content], False)} if content else {}
        one = Manifest(release, "robot", "u", "dataflow.yml", "/srv", "", "", 1, files=files)
        draft.publish(one, None)
        store.write_unit(release, text_of(release))
        store.prove(release)
    return store


def test_a_rollback(manager: FakeManager, scope: Scope, releases: Store, notes: Notes) -> None:
    assert releases.known()
    manager.add(release_options(OLD), Transient=False)
    told: list[str] = []
    done = roll_back(manager, scope, "robot", NEW, 0, lambda step: told.append(step.text))
    assert done == Deployed(UUID, "robot", UNIT, NEW, OLD, 1, 5, 0)
    assert told[0] == "checking"
    assert told[-1] == f"trial of {NEW}: passed"
    assert notes.found(*FACTS) == [STOPPED, COMMITTED]
    assert {one["DORA_BY"].partition(" ")[2] for one in notes.records} == {"(doractl rollback)"}
    told.clear()
    roll_back(manager, scope, "robot", NEW, 0, lambda step: told.append(step.text))
    assert told[0] == "checking", "what runs is not stopped for a damaged release"


def test_the_end_of_a_first_trial_that_was_killed(
    manager: FakeManager, scope: Scope, releases: Store, notes: Notes
) -> None:
    assert releases.known()
    path = read_standing(manager, scope, UNIT).path
    path.parent.mkdir(parents=True)
    path.write_text(text_of(NEW))
    manager.add(release_options(NEW), Transient=False, FragmentPath=str(path))
    done = roll_back(manager, scope, "robot", None, 0, print)
    assert done == Deployed(UUID, "robot", UNIT, "", NEW, 0, 0, 0)
    killed = "the command that tried it was killed"
    assert notes.found(*FACTS) == [STOPPED, ("release-rolled-back", NEW, "", "", killed)]
    (switch,) = releases.history()
    assert (switch.former, switch.how, switch.reason) == (NEW, "interrupted", killed)
    assert {one["DORA_BY"].partition(" ")[2] for one in notes.records} == {"(doractl rollback)"}


def test_what_a_rollback_refuses(manager: FakeManager, scope: Scope, releases: Store) -> None:
    manager.add(release_options(OLD), Transient=False)
    error = refusal(lambda: roll_back(manager, scope, "robot", f"{NEW}x", 0, print))
    assert error.message == f"robot has no release '{NEW}x'"
    assert (error.hint, error.code) == (f"did you mean {NEW} or {OLD}?", ExitCode.NOT_FOUND)
    error = refusal(lambda: roll_back(manager, scope, "robot", "zzz", 0, print))
    assert error.hint == "doractl releases robot lists all"
    error = refusal(lambda: roll_back(manager, scope, "robot", None, 0, print))
    assert error.message == "robot has no release before the present one that ran well"
    lists = "doractl releases robot lists all"
    assert error.hint == f"{lists}; give the id of one to run it in any case"
    assert error.code is ExitCode.NOT_FOUND
    releases.write_unit(NEW, "[Service]\nExecStart=/bin/true\n")
    error = refusal(lambda: roll_back(manager, scope, "robot", NEW, 0, print))
    assert error.message == f"cannot run release {NEW} of robot: it has no unit file of ours"
    assert error.hint == "doractl releases robot lists the others"
    assert error.code is ExitCode.BAD_INPUT


def test_a_change_that_a_power_cut_has_kept_from_being_written(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    deployed(manager)
    with locked(releases):
        releases.record(Switch(5, "", NEW, REPLACED))
    last, first = read_history(manager, scope, "robot")
    assert (last.former, last.release, first.release) == (NEW, OLD, NEW)


def test_the_state_of_a_release_that_nobody_can_read(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    deployed(manager)
    releases.doubt(NEW)
    for release, state in ((OLD, "current"), (NEW, "unproved")):
        rows = {row.id: row.state for row in read_releases(manager, scope, ["robot"])}
        assert rows[release] == state
        (releases.release(release) / "release.json").unlink()
    rows = {row.id: row.state for row in read_releases(manager, scope, ["robot"])}
    assert rows == {OLD: "current", NEW: "unknown"}


def test_a_unit_of_somebody_else_hides_no_finding(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    other = Store(releases.path.parent, "other")
    with locked(other):
        other.release(OLD).mkdir()
    (releases.path / ".new-0a1b2c3d4e5f").mkdir()
    etc(manager).parent.mkdir(parents=True)
    foreign = etc(manager).with_name("dora-other.service")
    foreign.write_text("[Service]\nExecStart=/bin/true\n")
    error = refusal(lambda: read_standing(manager, scope, foreign.name))
    first, second = judge_releases(manager, scope)
    assert first == Finding("releases", State.WARNING, error.message, error.hint)
    assert second.text.startswith(str(releases.path))
    rows = read_releases(manager, scope, ["other", "robot"])
    assert {(row.name, row.state) for row in rows} == {("other", "unknown"), ("robot", "proved")}
    assert refusal(lambda: read_releases(manager, scope, ["other"])).message == error.message


def test_what_doctor_says_of_a_sender_that_was_killed(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    with incoming(releases.path.parent) as draft:
        left = draft.tree.parent.with_name(".new-0a1b2c3d4e5f")
        left.mkdir()
        os.utime(left, (0, 0))
        text = f"{left} is the rest of a deploy -H that was killed"
        finding = Finding("releases", State.NOTE, text, "the next one removes it")
        assert list(judge_releases(manager, scope)) == [finding]


def test_what_a_deploy_that_runs_has_made_is_no_rest(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    (releases.path / ".new-0a1b2c3d4e5f").mkdir()
    with locked(releases):
        assert list(judge_releases(manager, scope)) == []
    assert len(list(judge_releases(manager, scope))) == 1


def test_nothing_is_made_of_a_dataflow_without_releases(manager: FakeManager, scope: Scope) -> None:
    manager.add(release_options(OLD))
    acts: tuple[Callable[[], object], ...] = (
        lambda: list(remove_releases(manager, scope, "robot", (OLD,))),
        lambda: roll_back(manager, scope, "robot", OLD, 0, print),
    )
    for error in map(refusal, acts):
        assert (error.message, error.code) == ("robot has no release", ExitCode.NOT_FOUND)
        assert error.hint == "doractl deploy --name robot makes the first one"
    assert not store_of(scope, "robot").path.exists()


def test_a_damaged_release(manager: FakeManager, scope: Scope, releases: Store) -> None:
    manager.add(release_options(OLD), Transient=False)
    gone = {name: Stored(1, False, "0" * 64) for name in ("b", "a", "c")}
    manifest = releases.manifest(NEW)
    releases.write_manifest(Manifest(**{**vars(manifest), "files": gone}))
    error = refusal(lambda: roll_back(manager, scope, "robot", NEW, 0, print))
    damage = "it is damaged: a and 2 more changed on the disk"
    assert error.message == f"cannot run release {NEW} of robot: {damage}"
    assert error.hint == "check the disk; doractl releases robot lists the others"


def test_a_dataflow_without_releases(manager: FakeManager, scope: Scope) -> None:
    manager.add(release_options(OLD))
    error = refusal(lambda: deployed_name(manager, scope, "robot"))
    assert (error.message, error.code) == ("robot has no release", ExitCode.NOT_FOUND)
    assert error.hint == "doractl deploy --name robot makes the first one"


def test_a_dataflow_that_has_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, manager: FakeManager, scope: Scope
) -> None:
    """The UUID of one with releases is in the journal, as for `doractl forget`."""
    FakeJournal(monkeypatch, tmp_path).write(
        life_record("dataflow-stopped", 1, "robot", UUID, scope=scope)
    )
    error = refusal(lambda: deployed_name(manager, scope, UUID[:8]))
    assert error.message == "robot has no release"
    store_of(scope, "robot").path.mkdir(parents=True)
    assert deployed_name(manager, scope, UUID[:8]) == "robot"


def test_what_is_forgotten(
    manager: FakeManager, scope: Scope, releases: Store, notes: Notes
) -> None:
    manager.add(release_options(OLD), "failed", Transient=False)
    kept = find_kept(manager, scope, "robot")
    assert (kept.name, kept.unit, kept.releases) == ("robot", UNIT, (OLD, NEW))
    forget(manager, scope, kept)
    assert not releases.path.exists()
    assert ("reset", UNIT) in manager.calls
    (note,) = notes.records
    assert (note["DORA_EVENT"], note["DORA_SCOPE"]) == ("dataflow-forgotten", "system")
    assert note["DORA_DATAFLOW"] == kept.uuid
    assert note["MESSAGE"].endswith(f" by {note['DORA_BY']}")
    assert note["DORA_BY"].endswith(" (doractl forget)")


def test_which_releases_cannot_be_removed(
    manager: FakeManager, scope: Scope, releases: Store
) -> None:
    def words(release: str) -> tuple[str, str, ExitCode]:
        error = refusal(lambda: list(remove_releases(manager, scope, "robot", (release,))))
        return error.message, error.hint, error.code

    deployed(manager)
    unknown = "20200101T000000"
    rollback = "doractl rollback robot, or deploy another release first"
    runs = f"cannot remove release {OLD} of robot: it is what every start runs"
    assert words(OLD) == (runs, rollback, ExitCode.NAME_IN_USE)
    message, hint, code = words("zzz")
    assert (message, code) == ("robot has no release 'zzz'", ExitCode.NOT_FOUND)
    assert hint == "doractl releases robot lists all"
    assert words(f"{NEW}x")[1] == f"did you mean {NEW} or {OLD}?"
    assert words(unknown)[0] == f"robot has no release {unknown!r}"
    path = read_standing(manager, scope, UNIT).path
    path.parent.mkdir(parents=True)
    path.write_text(text_of(NEW))
    trial = f"cannot remove release {NEW} of robot: it is on trial"
    assert words(NEW) == (trial, rollback, ExitCode.NAME_IN_USE)
    assert [one.id for one in releases.known()] == [OLD, NEW]


def test_what_doctor_says(manager: FakeManager, scope: Scope, releases: Store) -> None:
    deployed(manager)
    assert list(judge_releases(manager, scope)) == []
    draft = releases.path / ".new-0a1b2c3d4e5f"
    draft.mkdir()
    path = read_standing(manager, scope, UNIT).path
    path.parent.mkdir(parents=True)
    path.write_text(text_of(NEW))
    found = [(one.topic, one.state, one.text, one.remedy) for one in judge_releases(manager, scope)]
    on_trial = f"robot runs release {NEW} on trial, and the next boot does not"
    rest = f"{draft} is the rest of a deploy that was killed"
    remedy = "doractl deploy --name robot, or doractl rollback robot"
    assert found == [
        ("releases", State.WARNING, on_trial, remedy),
        ("releases", State.NOTE, rest, "the next deploy removes it"),
    ]


USER = Scope(is_user=True, uid=os.geteuid())
NODE = "nodes: [{id: a, path: %s}]\n"
PROJECTS: dict[str, tuple[str, dict[str, Any], str]] = {
    "hot reload is on, and the files of a release do not change": (
        *(NODE % "a.py", {"hot_reload": True}),
        "deploy with --no-hot-reload, or use doractl start",
    ),
    "node a: its path ROOT/a.py would be outside of the release": (
        *(NODE % "ROOT/a.py", {}, "write it relative to ROOT"),
    ),
    "uv is on, and would write to the release": (
        *(NODE % "a.py", {"uv": True}),
        "deploy with --no-uv: then uv makes .venv from uv.lock, also for build: pip install",
    ),
    "node a: its path ../x.py leads out of ROOT": (
        *(NODE % "../x.py", {}),
        "use --working-directory ABOVE, and write the path from there: x.py",
    ),
    "its working directory / is not in the project": (
        *(NODE % "a.py", {"working_directory": "/"}),
        "give a directory below the file, or above it, with --working-directory",
    ),
}


@pytest.mark.parametrize("reason", PROJECTS)
def test_projects_that_cannot_be_deployed(tmp_path: Path, reason: str) -> None:
    text, flags, hint = PROJECTS[reason]
    root = tmp_path / "project"
    root.mkdir()
    (root / "a.py").touch()
    (root / "dataflow.yml").write_text(text.replace("ROOT", str(root)))
    (tmp_path / "x.py").touch()
    make_program(tmp_path / "bin/uv")
    given = {"dora": make_program(tmp_path / "bin/dora"), **flags}
    request = StartRequest(str(root), None, given, {"PATH": str(tmp_path / "bin")})
    error = refusal(lambda: find_source(USER, request))
    assert error.message == f"cannot deploy: {reason.replace('ROOT', str(root))}"
    assert error.hint == hint.replace("ROOT", str(root)).replace("ABOVE", str(tmp_path))
    assert error.code is ExitCode.BAD_INPUT

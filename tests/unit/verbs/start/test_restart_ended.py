"""What a start leaves in the journal, and a start by name."""

import json
import socket
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.restart_ended import (
    Asked,
    find_known,
    find_start,
    means_name,
    note_start,
    recorded_file,
)
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, options

SCOPE = Scope(is_user=False, uid=0)
FLAGS = {"memory_limit": "1G", "env": ("A=1", "B=2"), "venv": ".venv", "debug": True, "uv": None}
KEPT = {
    "memory_limit": "1G",
    "env": ("A=1", "B=2"),
    "venv": "/home/robot/.venv",
    "debug": "yes",
    "grace_duration": "3s",
}


def record(name: str = "robot", uuid: str = UUID, **fields: Any) -> dict[str, Any]:
    settings = json.dumps(KEPT)
    own = {"DORA_DATAFLOW_NAME": name, "DORA_DATAFLOW": uuid, "DORA_FILE": f"/srv/{name}.yml"}
    own |= {"_UID": "0", "DORA_EVENT": "start-asked", "DORA_SCOPE": "system"}
    return {"_PID": "77", "DORA_SETTINGS": settings, **own, **fields}


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeJournal:
    return FakeJournal(monkeypatch, tmp_path)


def test_a_start_is_noted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sent: list[bytes] = []
    monkeypatch.setattr(socket.socket, "sendto", lambda _, data, *__: sent.append(data))
    monkeypatch.chdir(tmp_path)
    plan = Plan(SCOPE, options(), resolve_settings({}, {}, []), None, {})
    request = StartRequest("robot.yml", flags=FLAGS, environment={"DORA_GRACE_DURATION": "3s"})
    note_start(plan, request, "doractl start")
    (entry,) = sent
    lines = dict(line.split(b"=", 1) for line in entry.splitlines())
    kept = {**KEPT, "venv": str(tmp_path / ".venv"), "env": ["A=1", "B=2"]}
    assert json.loads(lines[b"DORA_SETTINGS"]) == kept
    assert lines[b"DORA_FILE"] == b"/srv/robot.yml"
    assert lines[b"DORA_SCOPE"] == b"system"
    assert lines[b"MESSAGE"].startswith(b"Start of dataflow robot requested by ")


@pytest.mark.parametrize(
    "text", ["robot", "dora-robot", "dora-robot.service", UUID, UUID[:8], UUID[:8].upper()]
)
def test_the_last_start(text: str, journal: FakeJournal) -> None:
    other, old = record("other", UUID.replace("5", "6")), record(DORA_FILE="/srv/old.yml")
    journal.write(other, record(), old)
    found = find_start(FakeManager(), SCOPE, Selector(text))
    assert isinstance(found, Asked)
    assert found == Asked("robot", UUID, "/srv/robot.yml", KEPT)
    given = {"env": ("C=3", "B=4"), "debug": None, "writable": (), "memory_limit": "2G"}
    wanted = StartRequest(text, flags=given)
    again = found.request(wanted)
    assert (again.dataflow, again.name, again.uuid) == ("/srv/robot.yml", "robot", UUID)
    assert again.flags == {**KEPT, "env": ["A=1", "B=4", "C=3"], "memory_limit": "2G"}
    assert again.changed == {"env", "memory_limit"}
    with pytest.raises(DoraSystemdError, match="cannot start robot as 'x'"):
        found.request(StartRequest(text, "x"))


FORGED: list[dict[str, Any]] = [
    {"_PID": "1"},
    {"DORA_FILE": "robot.yml"},
    {"DORA_FILE": None},
    {"DORA_DATAFLOW": "x"},
    {"DORA_DATAFLOW": ["a", "b"]},
    {"DORA_SETTINGS": "[1]"},
    {"DORA_SETTINGS": "{"},
    {"DORA_SETTINGS": [1, 2]},
    {"DORA_SETTINGS": "[" * 100_000},
]


@pytest.mark.parametrize("fields", FORGED)
def test_records_that_are_none(fields: dict[str, Any], journal: FakeJournal) -> None:
    journal.write(record(**fields))
    with pytest.raises(DoraSystemdError) as caught:
        find_start(FakeManager(), SCOPE, Selector("robot"))
    assert caught.value.code is ExitCode.NOT_FOUND


def test_what_systemd_knows_comes_first(journal: FakeJournal) -> None:
    manager = FakeManager()
    manager.add(options(), active="failed")
    journal.write(record(), record("gone", UUID.replace("5", "6")))
    found = find_start(manager, SCOPE, Selector("robot"))
    assert isinstance(found, Cell)
    cells, ended = find_known(manager, SCOPE, ["robot", "gone", "dora-gone", "rob*"])
    assert ([one.name for one in cells], [one.name for one in ended]) == (["robot"], ["gone"])
    # Other settings are for the plan of the last start.
    assert isinstance(find_start(manager, SCOPE, Selector("robot"), is_changed=True), Asked)
    journal.write()
    with pytest.raises(DoraSystemdError, match="the journal does not have its start"):
        find_start(manager, SCOPE, Selector("robot"), is_changed=True)


def test_an_end_without_a_start(journal: FakeJournal) -> None:
    """After a first deploy that failed, list and why know the name; it is no unknown one."""
    journal.write(life_record("dataflow-failed", 19, "robot", DORA_REASON="node a: exit code 1"))
    with pytest.raises(DoraSystemdError, match="cannot start robot: the journal") as caught:
        find_start(FakeManager(), SCOPE, Selector("robot"))
    assert "doractl deploy --name robot" in caught.value.hint
    assert caught.value.code is ExitCode.NOT_FOUND


def test_a_release_that_was_never_started_from_its_project(journal: FakeJournal) -> None:
    committed = record(DORA_EVENT="release-committed", DORA_RELEASE="20261121T220012")
    journal.write(life_record("dataflow-stopped", 19, "robot"), committed)
    with pytest.raises(DoraSystemdError, match="its release 20261121T220012 is disabled") as caught:
        find_start(FakeManager(), SCOPE, Selector("robot"))
    assert caught.value.hint == "doractl rollback robot 20261121T220012"
    assert caught.value.code is ExitCode.NOT_FOUND


def test_a_journal_that_cannot_be_read(journal: FakeJournal) -> None:
    journal.complain("No journal files were opened due to insufficient permissions.")
    with pytest.raises(DoraSystemdError, match="no dataflow named 'robot'"):
        find_start(FakeManager(), SCOPE, Selector("robot"))


def test_settings_of_nodes_and_lists_are_added_to_those_of_the_last_start() -> None:
    recorded = {
        "nodes": ("cam:memory_limit=1G", "cam:cpu_limit=1"),
        "writable": ("/a", "/b"),
        "property": ("LimitNOFILE=5", "LimitNOFILE=6"),
    }
    given = {
        "nodes": ("arm:memory_limit=2G", "cam:cpu_limit=2"),
        "writable": ("/a", "/c"),
        "property": ("LimitNOFILE=5",),
    }
    found = Asked("robot", UUID, "/srv/robot.yml", recorded)
    assert found.request(StartRequest("robot", flags=given)).flags == {
        "nodes": ["cam:memory_limit=1G", "cam:cpu_limit=200%", "arm:memory_limit=2G"],
        "writable": ["/b", "/a", "/c"],
        "property": ["LimitNOFILE=6", "LimitNOFILE=5"],
    }


@pytest.mark.parametrize(
    ("records", "file"),
    [
        ([record()], "/srv/robot.yml"),
        ([record(uuid=UUID.replace("5", "6"))], ""),
        ([record(DORA_EVENT="release-committed", DORA_RELEASE="a1"), record()], ""),
        ([], ""),
    ],
)
def test_the_file_of_what_has_ended(
    records: list[dict[str, Any]], file: str, journal: FakeJournal
) -> None:
    """It is unknown of a release, and if another dataflow has got the name since."""
    journal.write(*records)
    assert recorded_file(SCOPE, "robot", UUID) == file


def test_the_directory_of_a_dataflow(
    journal: FakeJournal, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`doractl deploy DIR` takes it, `doractl start` does not."""
    journal.write()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot/dataflow.yml").touch()
    with pytest.raises(DoraSystemdError, match="no dataflow named 'robot'") as caught:
        find_start(FakeManager(), SCOPE, Selector("robot"))
    assert caught.value.hint == "did you mean robot/dataflow.yml?"


def test_names_and_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "directory").mkdir()

    assert means_name("robot")
    assert means_name("directory")
    assert not any(map(means_name, ("file", "a.yml", "./robot", "b/robot")))

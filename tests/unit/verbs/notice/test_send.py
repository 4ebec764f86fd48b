"""A notice is about the dataflow as it was when it failed, whatever has become of its unit."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.journal.reader import Bounds, JournalReader
from dora_systemd.decisions.logs.journal_events import GIVEN_UP
from dora_systemd.decisions.notice.happened import FAILED, Happened
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.decisions.recorder.ring import ALIGN
from dora_systemd.decisions.recorder.writer import Writer
from dora_systemd.runner.recorder.keep import fitted_ring, header_of
from dora_systemd.runner.recorder.record import FileStore
from dora_systemd.verbs.bundles.listing import read_bundles
from dora_systemd.verbs.notice.send import Sender
from tests.unit.decisions.recorder.test_pictures import BATCH, SCHEMA
from tests.unit.fakes.manager import FakeManager, ScopeIn, options, with_texts
from tests.unit.fakes.notes import Notes
from tests.unit.fakes.recorder.ring import PAGE, message
from tests.unit.verbs.notice.failures import SECRET, fail

OTHER = "550e8400-e29b-41d4-a716-446655440001"
UNIT, COMMAND = "dora-robot.service", "doranotice-robot.service"
HAPPENED = [Happened(FAILED, 9, 9, "camera", "node camera: exit code 3")]
Robot = Callable[..., Sender]


@pytest.fixture
def robot(manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Robot:
    """Lets robot fail, with settings as texts; the service that sends its notices."""

    def failed(*texts: str, is_user: bool = False, bounds: Bounds | None = None) -> Sender:
        fail(manager, monkeypatch, tmp_path, with_texts(options(), *texts))
        scope = ScopeIn(is_user, os.getuid(), tmp_path / "run")
        (tmp_path / "place").mkdir()
        journal = JournalReader(bounds or Bounds())
        return Sender(manager, scope, "robot", journal, tmp_path / "place")

    return failed


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> Notes:
    return Notes(monkeypatch)


def events(notes: Notes) -> list[tuple[str, ...]]:
    return notes.found("DORA_EVENT", "DORA_REASON", "DORA_DATAFLOW")


def test_a_dataflow_that_is_stopped_before_its_notice(
    robot: Robot, manager: FakeManager, notes: Notes
) -> None:
    """The command runs as it would have, and a bundle is written."""
    sender = robot("on_failure=/bin/tell x", "black_box=yes")
    sender.learn()
    del manager.units[UNIT]
    sender.learn()
    sender.send(HAPPENED, 15)
    command = manager.units[COMMAND]
    assert command["User"] == "alice"
    assert f"KEY={SECRET}" in command["Environment"]
    written, sent = events(notes)
    assert written[0] == "bundle-written"
    assert sent[0] == "notice-sent"
    assert sent[1].endswith(" failed: node camera: exit code 3")
    assert sent[2] == options().uuid


def test_a_journal_that_is_read_too_slowly_after_a_boot(
    robot: Robot, notes: Notes, capsys: pytest.CaptureFixture[str]
) -> None:
    """The records of the boot before are missing, so nothing is known about the power."""
    sender = robot("black_box=yes", bounds=Bounds(size=0))
    sender.learn()
    sender.write_after_boot(now_us=1)
    assert capsys.readouterr().err.startswith("<4>cannot find out whether power was lost")
    assert events(notes) == []


def test_another_dataflow_of_that_name_without_the_setting(
    robot: Robot, manager: FakeManager, notes: Notes
) -> None:
    """The failure was before that."""
    sender = robot("on_failure=/bin/tell x")
    sender.learn()
    manager.add(options(uuid=OTHER))
    sender.learn()
    sender.send(HAPPENED, 15)
    ((event, _, uuid),) = events(notes)
    assert (event, uuid) == ("notice-sent", options().uuid)


def test_no_bundle_is_about_a_dataflow_that_did_not_ask_for_one(
    robot: Robot, manager: FakeManager, notes: Notes
) -> None:
    """It has the name of one that did, within the pause after a failure of that one.

    The bundle was about the stop of that one, which is another cause than that of its failure.
    """
    sender = robot("black_box=yes")
    sender.learn()
    manager.add(options(uuid=OTHER))
    sender.learn()
    sender.send([Happened(FAILED, 90, 80, uuid=OTHER)], 15)
    ((event, reason, until),) = notes.found("DORA_EVENT", "DORA_REASON", "DORA_UNTIL")
    assert (event, until) == ("bundle-refused", "80")
    assert reason.startswith("another dataflow with that name has failed")


def test_a_dataflow_that_is_started_again_before_its_notice(
    robot: Robot, manager: FakeManager, notes: Notes, tmp_path: Path
) -> None:
    """The bundle is about the failure of the first one, and not about the second one."""
    sender = robot("black_box=yes")
    sender.learn()
    manager.add(with_texts(options(uuid=OTHER), "black_box=keep=1,size=4M"))
    sender.learn()
    sender.send([HAPPENED[0]._replace(uuid=options().uuid)], 15)
    assert events(notes) == [("bundle-written", "", options().uuid)]
    (row,) = read_bundles(ScopeIn(False, os.getuid(), tmp_path / "run"), ["robot"])
    with opened(Path(row.file)) as bundle:
        assert bundle.manifest.uuid == options().uuid


@pytest.mark.parametrize(
    ("is_loaded", "reason"),
    [
        (True, "the dataflow has no on_failure any more"),
        (False, f"systemd had unloaded {UNIT} before its setting was read"),
    ],
)
def test_why_there_is_no_notice(
    robot: Robot, manager: FakeManager, notes: Notes, is_loaded: bool, reason: str
) -> None:
    sender = robot()
    if not is_loaded:
        del manager.units[UNIT]
    sender.learn()
    sender.send(HAPPENED, 15)
    assert [one[:2] for one in events(notes)] == [("notice-failed", reason)]
    assert COMMAND not in manager.units


def test_the_last_messages_are_those_at_the_failure(
    robot: Robot, manager: FakeManager, notes: Notes
) -> None:
    """systemd gives the memory of a recorder back when the dataflow is stopped or started again.

    Before systemd 254 also when it has failed, while the bundle of the node is written.
    """
    sender = robot("black_box=keep=5,size=20M", "record=yes", is_user=True)
    ring = fitted_ring(-1, header_of(Record(), ["camera/image"], {"uuid": options().uuid}))
    Writer(FileStore(ring, ALIGN), PAGE).put(0, message(BATCH, 5, SCHEMA))
    manager.units[UNIT]["MainPID"] = os.getpid()
    sender.learn()
    manager.units[UNIT]["MainPID"] = 0
    os.close(ring)
    for what in (GIVEN_UP, FAILED):
        sender.send([HAPPENED[0]._replace(what=what)], 15)
        file = Path(notes.found("DORA_FILE")[-1][0])
        with opened(file) as bundle:
            assert bundle.manifest.event == what
            assert "recording.mcap" in [one.name for one in bundle.manifest.parts]
            assert BATCH in bundle.read("recording.mcap")
        file.unlink()  # the next one would be too soon after it
        sender.learn()
    left = [str(one.readlink()) for one in Path("/proc/self/fd").iterdir() if one.exists()]
    assert not [one for one in left if "dora-ring" in one], "its memory is free"

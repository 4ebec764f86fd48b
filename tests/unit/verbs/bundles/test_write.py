"""`doractl bundle` of a dataflow that only the journal knows, and what is printed of it."""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.cell.black_box import BlackBox
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.notice.happened import POWER_LOST, Happened
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.why.report import format_report
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.bundles.listing import (
    find_name,
    kept_names,
    parse_why,
    read_bundles,
    read_report,
    remove_bundles,
)
from dora_systemd.verbs.bundles.write import Failure, write_after, write_bundle
from dora_systemd.verbs.facts.cells import read_cell
from dora_systemd.verbs.list import find_row
from dora_systemd.verbs.why import explain
from tests.unit.fakes.journal import FakeJournal, failure_record, life_record
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.verbs.notice.failures import SECRET, fail

Reach = Callable[[Scope], FakeManager]


@pytest.fixture
def reach(manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Reach:
    """A machine on which robot has failed; systemd still has its unit."""
    fail(manager, monkeypatch, tmp_path, options())

    def reached(_scope: Scope) -> FakeManager:
        return manager

    return reached


def test_a_bundle(reach: Reach, scope: ScopeIn, manager: FakeManager) -> None:
    done = write_bundle(reach, scope, "robot", "doractl bundle")
    assert done.path.parent == scope.state_root / "dora-systemd/bundles/robot"
    assert done.errors == ()
    with opened(done.path) as bundle:
        bundle.check()
        names = [one.name for one in bundle.manifest.parts]
        data = b"".join(map(bundle.read, names))
        assert bundle.manifest.by.endswith("(doractl bundle)")
        assert bundle.manifest.left_out[0] == (
            "cgroup.json and nodes.json: the dataflow does not run"
        )
    assert SECRET.encode() not in data
    assert b"Environment=KEY\n" in data
    readme, why = read_report(done.path)
    assert "robot: Failed" in readme
    assert parse_why(why, done.path)["name"] == "robot"
    assert kept_names(scope) == ["robot"]
    assert find_name(manager, scope, "robot") == "robot"
    (row,) = read_bundles(scope, ["robot"])
    assert row.manifest
    assert row.manifest.uuid == options().uuid
    other = done.path.parent.parent / "zebra"
    other.mkdir()
    for stamp in ("20200101T000000Z", "20990101T000000Z"):
        (other / f"zebra-{stamp}-requested.tar").touch()
    of_all = [one.name for one in read_bundles(scope, ["robot", "zebra"])]
    assert of_all == ["zebra", "robot", "zebra"], "newest first"
    assert list(remove_bundles(scope, "robot", [row.id])) == [row.id]
    assert read_bundles(scope, ["robot"]) == []


def test_another_place(reach: Reach, scope: ScopeIn, tmp_path: Path) -> None:
    place = tmp_path / "out.tar"
    done = write_bundle(reach, scope, "robot", "x", place, want_journal=False)
    assert done.path == place
    with opened(place) as bundle:
        assert "journal.export.gz" not in [one.name for one in bundle.manifest.parts]
        assert bundle.manifest.left_out[0].endswith("--no-journal")
    assert kept_names(scope) == []
    with pytest.raises(DoraSystemdError, match=r"a/b\.tar: No such file") as caught:
        write_bundle(reach, scope, "robot", "x", tmp_path / "a/b.tar")
    assert caught.value.code is ExitCode.BAD_INPUT
    assert caught.value.hint.startswith("create that directory first")
    with pytest.raises(DoraSystemdError, match="it is a directory") as caught:
        write_bundle(reach, scope, "robot", "x", tmp_path)
    assert caught.value.hint == "name a file in it"


def test_what_is_no_regular_file_is_not_replaced(
    reach: Reach, scope: ScopeIn, tmp_path: Path
) -> None:
    """Root would replace /dev/null, and /dev/stdout is a link."""
    (link := tmp_path / "link.tar").symlink_to(tmp_path / "other.tar")
    os.mkfifo(fifo := tmp_path / "fifo.tar")
    for place in (link, fifo):
        with pytest.raises(DoraSystemdError, match=r"tar: it is not a regular file$") as caught:
            write_bundle(reach, scope, "robot", "x", place)
        assert (caught.value.hint, caught.value.code) == ("name another file", ExitCode.BAD_INPUT)
    assert link.is_symlink() and fifo.is_fifo() and not (tmp_path / "other.tar").exists()
    (old := tmp_path / "old.tar").write_text("of yesterday")
    assert write_bundle(reach, scope, "robot", "x", old).path == old
    with opened(old) as bundle:
        bundle.check()


def test_an_unknown_one(reach: Reach, scope: ScopeIn) -> None:
    with pytest.raises(DoraSystemdError, match="no dataflow named 'rover'"):
        write_bundle(reach, scope, "rover", "x")
    with pytest.raises(DoraSystemdError, match="has no bundle x"):
        list(remove_bundles(scope, "robot", ["x"]))


def test_bundles_of_failures_are_bounded(
    reach: Reach, scope: ScopeIn, manager: FakeManager
) -> None:
    """One of the same node and cause in ten minutes; those that were requested do not count."""
    requested = write_bundle(reach, scope, "robot", "doractl bundle").path
    cell, box, now = read_cell(manager, "dora-robot.service"), BlackBox(2, 20 << 20), time.time()
    assert cell
    paths = []
    for minutes in (0, 5, 11, 22):
        failure = Failure("failed", {"until": "1", "pause": "2"})
        at_us = int(now + 60 * minutes) * 1_000_000
        paths.append(write_after(reach, scope, cell, box, failure, partial(int, at_us)))
    assert [bool(one) for one in paths] == [True, False, True, True]
    left = {row.id for row in read_bundles(scope, ["robot"])}
    assert left == {requested.name, *(Path(one).name for one in paths[2:])}
    row = find_row(manager, scope, "robot")
    assert row.bundles
    assert (row.bundles.kept, row.bundles.newest, row.bundles.refused) == (2, paths[-1], 1)
    shown = format_dataflow(row)
    assert f"Bundle:   {paths[-1]} and 1 more; 1 not written, the last: one about " in shown
    why = format_report(explain(manager, scope, "robot", JournalReader()))
    assert f"Bundle:   {paths[-1]} and 1 more" in why


def happening(event: str, at_us: int, **fields: str) -> dict[str, object]:
    """The record of a life event, as `why` finds it."""
    return {**life_record(event, at_us, MESSAGE_ID=EVENTS[event].message_id), **fields}


@pytest.mark.parametrize("what", ["failed", "node-given-up"])
def test_a_bundle_is_about_its_failure_whatever_came_after_that(
    reach: Reach,
    scope: ScopeIn,
    manager: FakeManager,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    what: str,
) -> None:
    """It was restarted, and stopped; a bundle that is requested then is about the stop."""
    first, second = ({"_SYSTEMD_INVOCATION_ID": one} for one in "12")
    crash = {"DORA_NODE": "camera", "DORA_EXIT": "exit code 3"}
    FakeJournal(monkeypatch, tmp_path).write(
        happening("dataflow-stopped", 20, **second),
        happening("stop-asked", 19, DORA_BY="root (doractl stop)"),
        happening("dataflow-starting", 15, **second),
        {**failure_record(10, "robot", options().uuid), "INVOCATION_ID": "1"},
        happening("dataflow-failed", 9, **first, DORA_REASON="node camera: exit code 3"),
        happening("node-given-up", 8, **first, **crash),
        happening("node-crashed", 7, **first, **crash),
        happening("dataflow-starting", 5, **first),
    )
    cell = read_cell(manager, "dora-robot.service")
    assert cell
    del manager.units["dora-robot.service"]
    reason = "exit code 3 after 2 restarts"
    happened = Happened(what, 10 if what == "failed" else 8, 0, "camera", reason)
    path = Path(write_after(reach, scope, cell, BlackBox(), Failure(what, {}, None, happened)))
    readme, _ = read_report(path)
    with opened(path) as bundle:
        about = bundle.manifest
    words = "exit code 3" if what == "failed" else reason
    assert (about.node, about.cause) == ("camera", "node-failed")
    assert about.summary == f"node camera: {words}"
    assert about.state == "Stopped"
    assert f"robot: {'Failed' if what == 'failed' else 'Degraded'}\n" in readme
    assert "the dataflow was Stopped" in readme
    requested = write_bundle(reach, scope, options().uuid, "doractl bundle").manifest
    assert (requested.node, requested.cause, requested.state) == ("", "", "Stopped")
    assert requested.summary == "stopped by root (doractl stop)"


def test_after_a_power_cut_there_is_no_recording(
    reach: Reach, scope: ScopeIn, manager: FakeManager
) -> None:
    cell = read_cell(manager, "dora-robot.service")
    assert cell
    path = write_after(reach, scope, cell, BlackBox(), Failure(POWER_LOST, {}))
    with opened(Path(path)) as bundle:
        assert bundle.manifest.event == "power-lost"
        assert "recording.mcap: power was lost" in bundle.manifest.left_out


def test_a_bundle_that_cannot_be_written_is_an_event(
    reach: Reach, scope: ScopeIn, manager: FakeManager
) -> None:
    scope.state_root.parent.mkdir(parents=True)
    scope.state_root.touch()
    cell = read_cell(manager, "dora-robot.service")
    assert cell
    failure = Failure("failed", {})
    assert write_after(reach, scope, cell, BlackBox(), failure) == ""

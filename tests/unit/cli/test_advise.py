"""`doractl advise`: which lives it reads, and how an advice gets into the settings file."""

import json
import os
from pathlib import Path

import pytest

from dora_systemd.decisions.advice.report import AdviceReport
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import STORE, TREE
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.verbs.advise import Project, apply, read_advice
from tests.unit.decisions.advice.synthetic import BEGIN
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, options, with_texts

USER = Scope(is_user=True, uid=os.geteuid())
MIB = 1 << 20
FLOW = """\
nodes:
  - {id: camera, path: camera.py, outputs: [image]}
  - {id: own, path: own.py, restart_policy: never}
  - {id: late, path: dynamic}
"""
SETTINGS = """\
# mine
nodes:
  camera:
    memory_limit: 100M  # tight
    stop: 5s
"""


def records(count: int = 3) -> list[dict[str, object]]:
    """Lives of an hour, of which the first node's stop takes 9 s; newest first."""
    found = []
    for number in range(count):
        begin = BEGIN + number * 86400 * SECOND
        kill: dict[str, object] = {
            "DORA_NODE": "camera",
            "DORA_OWNER": "node",
            "DORA_LIMIT": str(100 * MIB),
        }
        events: list[tuple[str, int, dict[str, object]]] = [
            ("dataflow-starting", 0, {}),
            ("node-ready", 1, {"DORA_NODE": "camera"}),
            ("dataflow-started", 1, {}),
            ("node-oom", 1000, kill),
            ("node-crashed", 1800, {"DORA_NODE": "own"}),
            ("dataflow-stopping", 3600, {}),
            ("node-exited", 3609, {"DORA_NODE": "camera", "DORA_HELD_PEAK": str(90 * MIB)}),
            ("node-exited", 3609, {"DORA_NODE": "late", "DORA_HELD_PEAK": str(90 * MIB)}),
            ("dataflow-stopped", 3610, {"DORA_HELD_PEAK": str(200 * MIB)}),
        ]
        for name, at, more in events:
            record = life_record(name, begin + at * SECOND, scope=USER)
            found.append({**record, "_SYSTEMD_INVOCATION_ID": f"{number:032}", **more})
    return found[::-1]


class Place:
    """Write a dataflow file and its settings file, and a journal with lives of the dataflow."""

    def __init__(self, patch: pytest.MonkeyPatch, root: Path) -> None:
        self.journal = FakeJournal(patch, root)
        self.project = root / "project"
        self.project.mkdir()
        self.flow = self.project / "robot.yml"
        self.flow.write_text(FLOW)
        self.settings = self.project / "robot.systemd.yml"
        self.settings.write_text(SETTINGS)
        self.manager = FakeManager()
        self.environment = {"HOME": str(root / "home"), "DORA_MEMORY_LIMIT": "1G"}
        self.journal.write(*records())

    def load(self) -> None:
        self.manager.add(options()._replace(dataflow=str(self.flow)))

    def asked(self, **flags: str) -> dict[str, object]:
        """The record of its start, which outlives its unit."""
        fields = {"DORA_FILE": str(self.flow), "DORA_SETTINGS": json.dumps(flags)}
        return {
            **life_record("start-asked", BEGIN, scope=USER, **fields),
            "DORA_SCOPE": "user",
            "_PID": "77",
        }

    def read(self) -> tuple[AdviceReport, Project | None]:
        return read_advice(self.manager, USER, "robot", self.environment)

    def apply(self) -> AdviceReport:
        return apply(*self.read())


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Place:
    return Place(monkeypatch, tmp_path)


def shown(report: AdviceReport) -> list[tuple[str, ...]]:
    return [(one.node, one.setting, one.now, one.value) for one in report.advices]


MEMORY = ("camera", "memory_limit", "100M", "152M")
POLICY = ("camera", "restart_policy", "no", "on-failure")
ADVICES = [MEMORY, POLICY, ("camera", "stop.within", "5s", "10s 800ms")]


def test_a_loaded_dataflow(place: Place) -> None:
    place.load()
    report, project = place.read()
    assert (report.recorded.lives, report.recorded.duration_us) == (3, 3 * 3609 * SECOND)
    assert project
    assert (report.uuid, report.file) == (UUID, str(place.settings))
    assert shown(report) == ADVICES
    assert not report.is_applied


def test_an_ended_dataflow_is_known_by_its_start(place: Place) -> None:
    place.journal.write(*records(), place.asked(grace_duration="30s"))
    assert shown(place.read()[0]) == ADVICES
    place.settings.unlink()
    report, _ = place.read()
    assert shown(report) == [("camera", "memory_limit", "", "152M"), POLICY], "30 s are enough"


def test_a_dataflow_that_nobody_knows(place: Place) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        place.read()
    assert caught.value.code is ExitCode.NOT_FOUND


def test_only_what_is_needed_is_read(place: Place) -> None:
    place.load()
    place.read()
    (call,) = [one for one in place.journal.asked if "node-oom" in one]
    assert "_SYSTEMD_USER_UNIT=dora-robot.service" in call
    assert "DORA_HELD_PEAK" in call
    assert "MESSAGE," not in call


def test_it_is_written_and_all_else_stays(place: Place) -> None:
    place.load()
    place.settings.chmod(0o600)
    report = place.apply()
    assert report.is_applied
    assert place.settings.read_text() == (
        "# mine\nnodes:\n  camera:\n    memory_limit: 152M  # tight\n    stop: 10s 800ms\n"
        "    restart_policy: on-failure\n"
    )
    assert place.settings.stat().st_mode & 0o777 == 0o600
    after, _ = place.read()
    assert shown(after) == []
    before = place.settings.stat().st_ino
    assert not place.apply().is_applied
    assert place.settings.stat().st_ino == before, "nothing to write"


def test_a_file_is_made(place: Place) -> None:
    place.load()
    place.settings.unlink()
    place.apply()
    assert place.settings.read_text() == (
        "nodes:\n  camera:\n    memory_limit: 152M\n    restart_policy: on-failure\n"
    )


def test_a_mark_of_utf_8_stays(place: Place) -> None:
    place.load()
    place.settings.write_bytes(b"\xef\xbb\xbf" + SETTINGS.encode())
    place.apply()
    assert place.settings.read_bytes().startswith(b"\xef\xbb\xbf# mine\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "nodes: &x\n  camera: &a {memory_limit: 100M}\n  own: *a\n",
            "write nodes: camera: memory",
        ),
        (
            "nodes:\n  camera:\n    memory_limit: |\n      100M\n",
            "write nodes: camera: memory_limit",
        ),
    ],
)
def test_what_cannot_be_written_changes_nothing(place: Place, text: str, words: str) -> None:
    place.load()
    place.settings.write_text(text)
    with pytest.raises(DoraSystemdError) as caught:
        place.apply()
    assert words in caught.value.hint
    assert caught.value.code is ExitCode.BAD_INPUT
    assert place.settings.read_text() == text


def test_a_file_that_was_changed_meanwhile(place: Place) -> None:
    place.load()
    report, project = place.read()
    place.settings.write_text("# newer\n")
    with pytest.raises(DoraSystemdError, match="it was changed meanwhile"):
        apply(report, project)
    assert place.settings.read_text() == "# newer\n"


def test_a_release_has_the_settings_of_its_project(place: Place) -> None:
    copy = place.project / STORE / "robot/20261121T220012" / TREE / "robot.yml"
    copy.parent.mkdir(parents=True)
    copy.write_text(FLOW)
    texts = with_texts(options(), "camera:memory_limit=100M", "camera:stop=within=5s")
    unit = place.manager.add(texts._replace(dataflow=str(copy)))
    place.manager.units[unit] |= {"MemoryMax": INFINITY, "CPUQuotaPerSecUSec": INFINITY}
    report, project = place.read()
    assert (shown(report), report.file, project) == (ADVICES, "", None)
    with pytest.raises(DoraSystemdError, match="it runs a release"):
        apply(report, project)

"""The course of a build, from the project to what a release has of it, with each of its ends."""

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.bus.manager import Beside, Observer, Property
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.verbs.releases.build import end_former
from dora_systemd.verbs.releases.deploy import Deployed, DeployRequest, deploy
from tests.unit.fakes.deploys import Bench, Systemd
from tests.unit.fakes.manager import FakeManager
from tests.unit.fakes.notes import Notes

UNIT = "doractl-build-robot.service"
FLOW = "nodes: [{id: a, path: a.py, build: make}]\n"
BEGUN = {
    **{"LoadState": "loaded", "ActiveState": "activating", "SubState": "start", "Job": (7, "/")},
    **{"Description": "", "StatusText": "", "Result": "success"},
    **{"ExecMainCode": 1, "ExecMainStatus": 0},
}
DONE = {"ActiveState": "inactive", "Job": (0, "/")}
FAILED = {**DONE, "ActiveState": "failed"}
PRINTED = f"journalctl --user --unit {UNIT} has all that it printed"


class Builder(Systemd):
    """Its build finds at each look what `looks` says next. work: what the build makes in a tree."""

    def __init__(self, root: Path, scope: Scope) -> None:
        super().__init__(root, scope)
        self.looks: list[dict[str, Any]] = [DONE]
        self.work: Callable[[Path], object] = bool
        self.sent: dict[str, Any] = {}
        self.kinds: dict[str, str] = {}
        self.seen = 0

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        if unit != UNIT:
            return super().start_transient(unit, properties, observer, wait, beside)
        self.calls.append(("start", unit, wait))
        self.sent = {name: value for name, _, value in properties}
        self.kinds = {name: kind for name, kind, _ in properties}
        self.units[unit] = {**BEGUN}
        self.work(Path(self.sent["BindPaths"][-1][0]))
        return ""

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        if unit == UNIT and "Job" in names:
            self.seen += 1
            self.units[unit] |= self.looks.pop(0) if len(self.looks) > 1 else self.looks[0]
        return super().read(unit, names)


class BuildBench(Bench):
    """A project with a node that is built."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.systemd = self.manager = Builder(root, self.scope)
        self.write("dataflow.yml", FLOW)

    def build(self, timeout: int = 600 * SECOND) -> Deployed:
        request = DeployRequest(self.start(), 0, 3, want_boot=True, build_timeout=timeout)
        tell, warn = self.steps.append, self.warnings.append
        return deploy(self.manager, self.scope, request, tell, warn)

    def refusal(self, timeout: int = 600 * SECOND) -> DoraSystemdError:
        with pytest.raises(DoraSystemdError) as caught:
            self.build(timeout)
        return caught.value


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, which only a sleep changes."""
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    return now


@pytest.fixture(autouse=True)
def notes(monkeypatch: pytest.MonkeyPatch) -> Notes:
    return Notes(monkeypatch)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BuildBench:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return BuildBench(tmp_path)


def test_what_is_built_belongs_to_the_release(bench: BuildBench) -> None:
    def work(tree: Path) -> None:
        assert (tree / "a.py").read_text() == ""
        assert (tree / "a.py").stat().st_mode & 0o777 == 0o644, "the build may change it"
        (tree / "a.py").write_text("print()")
        (tree / "made").write_text("made")

    bench.systemd.work = work
    done = bench.build()
    files = bench.store.manifest(done.release).files
    assert {path: one.is_built for path, one in files.items()} == {
        **{"a.py": False, "dataflow.yml": False, "made": True}
    }
    assert (bench.store.tree(done.release) / "a.py").read_text() == "print()"
    assert (done.files, done.size) == (3, len(FLOW) + len("print()") + len("made"))
    assert bench.store.unfinished() == []
    assert (bench.project / "a.py").read_text() == ""
    assert bench.texts[:2] == ["copying: 0B of 42B", "copying: 42B of 42B"]


def test_a_virtual_environment_that_the_build_makes(bench: BuildBench) -> None:
    def work(tree: Path) -> None:
        (tree / ".venv/bin").mkdir(parents=True)
        (tree / ".venv/pyvenv.cfg").touch()
        (tree / ".venv/bin/python").symlink_to("/usr/bin/python3")
        place = bench.systemd.sent["BindPaths"][-1][1]
        (tree / ".venv/bin/a").symlink_to(f"{place}/a.py")
        (tree / "top").symlink_to(f"{place}/a.py")

    bench.systemd.work = work
    done = bench.build()
    venv = f"{bench.store.tree(done.release)}/.venv"
    assert f" --venv={venv} " in bench.store.unit(done.release)
    own = {f"VIRTUAL_ENV={venv}", f"UV_PROJECT_ENVIRONMENT={venv}"}
    variables = bench.systemd.sent["Environment"]
    assert own <= {*variables}
    assert [one for one in variables if one.startswith(f"PATH={venv}/bin:")]
    files = bench.store.manifest(done.release).files
    links = {path: one.target for path, one in files.items() if one.target}
    inside = f"{bench.store.tree(done.release)}/a.py"
    assert links == {
        **{".venv/bin/a": inside, ".venv/bin/python": "/usr/bin/python3", "top": inside}
    }
    assert bench.warnings == [], "no other release shares it"


def test_its_unit(bench: BuildBench) -> None:
    done = bench.build()
    sent, tree = bench.systemd.sent, bench.store.tree(done.release)
    ((program, words, may_fail),) = sent["ExecStart"]
    assert words[0] == program
    assert not may_fail
    assert f'"name": "robot", "uuid": "{done.uuid}", "release": "{done.release}"' in words[-1]
    assert f'"directory": "{tree}"' in words[-1]
    command = f'"commands": [["{bench.dora}", "build", "--local", "{tree}/dataflow.yml"], ["/bin'
    assert command in words[-1]
    kinds = {"Description": "s", "KillSignal": "i", "CollectMode": "s", "AddRef": "b"}
    assert kinds.items() <= bench.systemd.kinds.items(), "systemd takes no other types"
    assert {
        name: sent[name] for name in ("Description", "KillSignal", "CollectMode", "AddRef")
    } == {
        "Description": f"build of release {done.release} of dora dataflow robot",
        "KillSignal": 9,
        "CollectMode": "inactive-or-failed",
        "AddRef": True,
    }
    assert sent["BindPaths"][-1][1] == str(tree)
    assert sent["TemporaryFileSystem"][-1] == (str(bench.store.path.parent), "ro")
    assert sent["TimeoutStartUSec"] == 600 * SECOND
    assert sent["PrivateUsers"] is True
    assert isinstance(sent["StandardInputFileDescriptor"], int)
    assert [one for one in bench.manager.calls if UNIT in one] == [("start", UNIT, False)]


def test_what_is_told_meanwhile(bench: BuildBench) -> None:
    bench.systemd.looks = [
        *({}, {"StatusText": "one"}, {"StatusText": ""}, {"StatusText": "two"}),
        *({"StatusText": "failed: no"}, DONE),
    ]
    bench.build()
    told = [one for one in bench.texts if one.startswith("building")]
    assert told == ["building", "building: one", "building: two"]


REFUSED = {**FAILED, "ExecMainStatus": 77, "StatusText": "failed: cannot use x: y; hint: z"}
ENDS: dict[str, dict[str, Any]] = {
    "cannot build robot: exit code 2": {**FAILED, "Result": "exit-code", "ExecMainStatus": 2},
    "cannot build robot: make: exit code 2": {
        **{**FAILED, "Result": "exit-code", "StatusText": "failed: make: exit code 2"},
        "ExecMainStatus": 1,
    },
    "cannot build robot: it ran out of memory": {
        **{**FAILED, "Result": "oom-kill", "ExecMainCode": 2, "ExecMainStatus": 9}
    },
    "cannot use x: y": {**REFUSED, "Result": "exit-code"},
}


@pytest.mark.parametrize(("message", "end"), ENDS.items())
def test_a_build_that_fails_leaves_nothing(
    bench: BuildBench, notes: Notes, message: str, end: dict[str, Any]
) -> None:
    bench.systemd.looks = [{}, end]
    error = bench.refusal()
    assert (error.message, error.hint, error.code) == (message, PRINTED, ExitCode.BAD_INPUT)
    assert bench.releases == {}
    assert not bench.store.path.exists()
    (note,) = notes.records
    reason = message.removeprefix("cannot build robot: ")
    text = f"Release {note['DORA_RELEASE']} of dataflow robot could not be built: {reason}"
    assert (note["MESSAGE"], note["DORA_EVENT"]) == (text, "build-failed")
    asked = {"DORA_REASON": reason, "DORA_SCOPE": "user", "DORA_DATAFLOW_NAME": "robot"}
    assert asked.items() <= note.items()
    assert len(note["DORA_DATAFLOW"]) == 36
    assert note["DORA_BY"].endswith(" (doractl deploy)")


def test_systemd_ends_one_that_lasts_too_long(bench: BuildBench) -> None:
    bench.systemd.looks = [{**FAILED, "Result": "timeout"}]
    error = bench.refusal()
    assert error.message == "cannot build robot: it did not end within 10min"
    assert error.hint == f"{PRINTED}; --build-timeout allows more time"
    assert ("StopUnit", UNIT) not in bench.manager.calls


def test_one_that_systemd_does_not_end_is_stopped(bench: BuildBench) -> None:
    """Its main process may ask for more time again and again."""
    bench.systemd.looks = [{}]
    error = bench.refusal(60 * SECOND)
    assert error.message == "cannot build robot: it did not end within 1min"
    assert error.hint == f"{PRINTED}; --build-timeout allows more time"
    assert bench.systemd.seen == pytest.approx(450, abs=3), "90 s, five times in a second"
    assert ("StopUnit", UNIT) in bench.manager.calls


def test_one_that_may_last_for_ever(bench: BuildBench) -> None:
    bench.systemd.looks = [*({} for _ in range(5000)), DONE]
    bench.build(INFINITY)
    assert bench.systemd.seen == 5001


def test_one_that_fills_the_disk_is_stopped(
    bench: BuildBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    statvfs = os.statvfs
    bench.systemd.looks = [{}]

    def fill(_tree: Path) -> None:
        free = dict.fromkeys(("f_bavail", "f_favail"), 0)

        def full(path: Any) -> Any:
            found = statvfs(path)
            names = ("f_frsize", "f_blocks", "f_files")
            facts = {name: getattr(found, name) for name in names}
            return type("Room", (), {**facts, **free})

        monkeypatch.setattr(os, "statvfs", full)

    bench.systemd.work = fill
    error = bench.refusal()
    assert error.message == "cannot build robot: it has left too little space on the disk"
    assert (error.hint, error.code) == (f"see df {bench.store.path}", ExitCode.FAILURE)
    assert ("StopUnit", UNIT) in bench.manager.calls


def test_what_no_release_can_have(bench: BuildBench, notes: Notes) -> None:
    bench.systemd.work = lambda tree: os.mkfifo(tree / "pipe")
    error = bench.refusal()
    assert error.message == "cannot copy pipe: it is a FIFO"
    assert error.hint.startswith("the build has left it: have the build remove it")
    assert notes.found("DORA_EVENT", "DORA_REASON") == [("build-failed", error.message)]
    assert not bench.store.path.exists()


class Former(FakeManager):
    """A former build. goes: after so many requests to reset it."""

    def __init__(self, active: str, goes: int, load: str = "loaded") -> None:
        super().__init__()
        self.units[UNIT] = {**BEGUN, "ActiveState": active, "LoadState": load}
        self.goes = goes

    def reset_failed(self, unit: str) -> None:
        self.calls.append(("reset", unit))
        self.goes -= 1
        if self.goes <= 0:
            del self.units[unit]
            raise DoraSystemdError("it is unloaded")


STOP, RESET = ("StopUnit", UNIT), ("reset", UNIT)


@pytest.mark.parametrize(
    ("former", "calls", "seconds"),
    [
        (Former("active", 1, "not-found"), [], 0),
        (Former("inactive", 1), [RESET], 0.2),
        (Former("failed", 1), [RESET], 0.2),
        (Former("activating", 1), [STOP, RESET], 0.2),
        (Former("deactivating", 2), [STOP, RESET] * 2, 0.4),
        (Former("failed", 10**6), [RESET] * 100, 20),
    ],
)
def test_the_build_of_a_killed_deploy_ends(
    former: Former, calls: list[tuple[str, str]], seconds: float, clock: list[float]
) -> None:
    end_former(former, UNIT)
    assert former.calls[: len(calls)] == calls
    assert len(former.calls) <= len(calls) + 1
    assert clock[0] - 1000 == pytest.approx(seconds, abs=0.3 if seconds > 1 else 0.01)

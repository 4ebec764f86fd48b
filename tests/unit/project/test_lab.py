"""The parts of the test lab that need neither root nor an image."""

import io
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from lab import cache, cgroup, definition, initrd, pace, wire
from lab.changed import find_rooms
from lab.errors import LabError
from lab.marked import marked_files
from lab.options import FORMS, parse_options
from lab.plans import PLANS, WITH_TOOLS
from lab.slow import read_speed
from lab.steps import Result, Step, predecessors, read_summary, run_steps, total, whole_minutes

from tests.system.tolerated import TOLERATED, is_tolerated

PYPROJECT = '[project]\nname = "x"\n[tool.ruff]\nline-length = 100\n'


def test_other_debians_get_what_the_package_asks_for() -> None:
    control = definition.read_part(definition.CHECKOUT / "packaging/debian/control")
    depends = re.search(r"^Depends: (.*?)^Recommends:", control, re.M | re.S)
    assert depends is not None
    wanted = set(re.findall(r"python3-\w+", depends[1]))
    assert wanted <= set(definition.PLATFORM_PACKAGES)


def test_the_lab_runs_what_is_skipped_without_its_programs() -> None:
    tests = (definition.CHECKOUT / "tests/unit").rglob("test_*.py")
    asking = {
        str(one.relative_to(definition.CHECKOUT))
        for one in tests
        if "\nfrom tests.unit.tools import require" in one.read_text()
    }
    assert asking == set(WITH_TOOLS)
    assert all(asking <= set(step.command) for step in PLANS["other-python"]("container"))


def test_options_of_run() -> None:
    options = parse_options(["run", "--env", "A=1=2", "--env", "B", "--", "x", "--env"], {"B": "b"})
    assert options.form == "container"
    assert options.commands == (("x", "--env"),)
    assert options.env == (("A", "1=2"), ("B", "b"))


def test_the_dashes_are_optional() -> None:
    assert parse_options(["run", "ls", "-l"], {}).commands == (("ls", "-l"),)


def test_only_the_first_dashes_are_the_labs() -> None:
    assert parse_options(["run", "--", "x", "--", "y"], {}).commands == (("x", "--", "y"),)


def test_commands_around_a_reboot() -> None:
    options = parse_options(["run", "--", "a", "b", "--reboot--", "c"], {"LAB": "vm"})
    assert options.form == "vm"
    assert options.commands == (("a", "b"), ("c",))


def test_a_command_that_cuts_the_power() -> None:
    assert parse_options(["run", "--cuts", "--", "a"], {"LAB": "vm"}).cuts
    assert not parse_options(["run", "--", "a", "--cuts"], {"LAB": "vm"}).cuts


@pytest.mark.parametrize(
    ("arguments", "environ", "message"),
    [
        (
            ["run", "--cuts", "x"],
            {},
            "lab: cannot cut the power of a container (hint: LAB=vm)",
        ),
        (["run"], {}, "lab: cannot run nothing (hint: lab run -- CMD)"),
        (["run", "a", "--reboot--"], {}, "lab: cannot run nothing (hint: lab run -- CMD)"),
        (
            ["run", "x"],
            {"LAB": "moon"},
            f"lab: cannot use LAB=moon (hint: one of {', '.join(FORMS)})",
        ),
        (
            ["run", "x"],
            {"LAB_OUT": "/no/such"},
            "lab: cannot use LAB_OUT=/no/such (hint: an existing directory)",
        ),
        (
            ["run", "--env", "1=2", "x"],
            {},
            "lab: cannot pass the variable '1' (hint: --env NAME or --env NAME=VALUE)",
        ),
    ],
)
def test_refused(arguments: list[str], environ: dict[str, str], message: str) -> None:
    with pytest.raises(LabError) as caught:
        parse_options(arguments, environ)
    assert str(caught.value) == message


def test_key_ignores_linters_and_sees_dependencies() -> None:
    key = definition.project_key(PYPROJECT, "")
    assert key == definition.project_key(PYPROJECT.replace("100", "80"), "")
    assert key != definition.project_key(PYPROJECT.replace('"x"', '"y"'), "")
    assert key != definition.project_key(PYPROJECT, "u dora -")


def test_interrupted_build_is_not_a_finished_one(tmp_path: Path) -> None:
    def build_half(path: Path) -> None:
        (path / "half").touch()
        raise LabError("go on")

    with pytest.raises(LabError):
        cache.ensure(tmp_path, cache.Layer("tree", "k", build_half))
    whole = cache.ensure(tmp_path, cache.Layer("tree", "k", lambda path: (path / "whole").touch()))
    assert [path.name for path in whole.iterdir()] == ["whole"]
    assert not list(tmp_path.glob("*.tmp"))


def test_old_layers_are_removed_unless_in_use(tmp_path: Path) -> None:
    for key in "abcd":
        cache.ensure(tmp_path, cache.Layer("tree", key, lambda _: None))
    # ensure() holds each against removal for as long as this process lives.
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 4
    old = tmp_path / "tree-old"
    old.mkdir()
    cache.remove_layer(old)
    assert not old.exists()


def test_frames_survive_any_split() -> None:
    stream = io.BytesIO(wire.pack_frame(b"O", b"x" * 100_000) + wire.pack_frame(b"X", b"0"))
    assert wire.read_frame(lambda count: stream.read(min(count, 7))) == (b"O", b"x" * 100_000)
    assert wire.read_frame(stream.read) == (b"X", b"0")
    with pytest.raises(EOFError):
        wire.read_frame(stream.read)


def test_initrd_members_are_aligned() -> None:
    entry = initrd.format_entry("init", 0o100755, b"12345")
    assert entry.startswith(b"070701")
    assert len(entry) % 4 == 0
    assert b"init\0" in entry


@pytest.mark.parametrize(
    ("line", "summary"),
    [
        ("===== 3 passed, 1 skipped in 0.12s =====", "3 passed, 1 skipped in 0.12s"),
        ("=== 120 passed in 75.31s (0:01:15) ===", "120 passed in 75.31s (0:01:15)"),
        ("tests/unit/project/test_lab.py ....", ""),
        ("2 cats in a box", ""),
    ],
)
def test_summary_of_pytest(line: str, summary: str) -> None:
    assert read_summary(line) == summary


@pytest.mark.parametrize(
    ("results", "words"),
    [
        ([(0, "3 passed in 1.0s")], "3 passed"),
        ([(0, "3 passed, 1 skipped in 1s"), (0, "done")], "3 passed, 1 skipped"),
        ([(1, "1 failed, 2 passed, 2 errors in 9s"), (0, "4 passed in 1s")],
         "1 failed, 6 passed, 2 error"),
        ([(0, "3 passed in 1s"), (125, "done")], "1 failed, 3 passed"),
        ([(0, "3 passed in 1s"), (1, "2 passed in 1s")], "1 failed, 5 passed"),
        ([(0, "done")], "1 passed"),
    ],
)  # fmt: skip
def test_one_summary_for_all(results: list[tuple[int, str]], words: str) -> None:
    assert total([Result("one", *given) for given in results]) == words


PYTEST_PRINTS = """\
_____________________ test_one[a] _____________________
    def test_one():
>       assert f() == 2
E       assert 1 == 2
{more}
_ ERROR at teardown of test_two _
E   AssertionError: unexpected warning
=============== short test summary info ===============
FAILED tests/test_x.py::test_one[a] - assert 1 == 2
ERROR tests/test_x.py::test_two - AssertionError
============== 1 failed, 1 error in 1.00s ==============
"""


def test_what_failed_is_shown_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    text = PYTEST_PRINTS.format(more="E         more\n" * 20)
    fails = Step("bad", ["sh", "-c", 'printf %s "$0"; exit 1', text], os.environ.copy)
    run_steps([fails, replace(fails, name="fine", command=["echo", text])])
    said = capfd.readouterr().err.split("s of processor time\n")[-1]
    assert said.splitlines() == [
        f"lab: bad: {line}"
        for line in (
            "test_one[a]",
            "E       assert 1 == 2",
            *["E         more"] * 7,
            "ERROR at teardown of test_two",
            "E   AssertionError: unexpected warning",
            "FAILED tests/test_x.py::test_one[a] - assert 1 == 2",
            "ERROR tests/test_x.py::test_two - AssertionError",
        )
    ]


def test_all_steps_run_and_the_worst_status_counts(capfd: pytest.CaptureFixture[str]) -> None:
    scripts = ["echo one", "echo '== 2 failed, 1 passed in 1.00s =='; exit 1", "kill -TERM $$"]
    steps = [
        Step(f"step {n}", ["sh", "-c", text], os.environ.copy) for n, text in enumerate(scripts)
    ]
    steps[0] = replace(steps[0], minutes=3)
    steps[1] = replace(steps[1], after=(), minutes=2)
    assert run_steps(steps) == 143
    out, said = capfd.readouterr()
    assert "3 steps, about 3 minutes on two cores" in said
    assert "step 2 of 3, 0 min: step 1" in said
    assert "step 0: ok; done" in said
    assert "step 1: FAILED with exit status 1; 2 failed, 1 passed in 1.00s" in said
    assert "step 2: FAILED with exit status 143; done" in said
    assert said.count(" s of processor time") == 3
    assert re.fullmatch(r"===== 3 failed, 1 passed in \d+\.\d\ds =====", out.splitlines()[-1])


def test_the_processor_time_of_a_step_is_that_of_all_it_waits_for(
    capfd: pytest.CaptureFixture[str],
) -> None:
    busy = "import time\nwhile time.process_time() < 1.1: pass"
    command = ["sh", "-c", f"{sys.executable} -c '{busy}'"]
    run_steps([Step("busy", command, os.environ.copy), Step("idle", ["true"], os.environ.copy)])
    said = capfd.readouterr().err
    assert re.search(r"busy: ok; done; [12] s of processor time", said)
    assert "idle: ok; done; 0 s of processor time" in said


def test_the_processor_time_of_containers_is_that_of_the_step(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "cpu.stat").write_text("usage_usec 70000000\nuser_usec 1\n")
    script = "from lab.cgroup import note_usage; import sys; from pathlib import Path; "
    script += "note_usage(Path(sys.argv[1])); note_usage(Path('/nowhere'))"
    command = [sys.executable, "-c", script, str(tmp_path)]
    place = {**os.environ, "PYTHONPATH": str(definition.CHECKOUT / "tests")}
    run_steps([Step("lab", command, place.copy), Step("idle", ["true"], os.environ.copy)])
    said = capfd.readouterr().err
    assert re.search(r"lab: ok; done; 7[0-5] s of processor time", said)
    assert "idle: ok; done; 0 s of processor time" in said


def test_nobody_has_to_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "cpu.stat").write_text("usage_usec 7\n")
    monkeypatch.delenv(cgroup.USAGE, raising=False)
    cgroup.note_usage(tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["cpu.stat"]


def test_files_with_a_mark(tmp_path: Path) -> None:
    texts = {
        "test_one.py": "@pytest.mark.vm\n",
        "test_other.py": "@pytest.mark.lab\n",
        "cells.py": "",
        "faults/conftest.py": "marks = [pytest.mark.vm]\n",
        "faults/test_faults.py": "",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = [str(path.relative_to(tmp_path)) for path in marked_files("vm", tmp_path)]
    assert found == ["faults/test_faults.py", "test_one.py"]
    for mark in ("vm", "emulator", "openarm", "browser"):
        assert marked_files(mark)


STEPS = """
import os, sys
from lab.steps import Step, run_steps
run_steps([Step("endless", ["sh", "-c", "echo begun; exec sleep 1000"], os.environ.copy)])
"""


def test_steps_that_run_at_the_same_time(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Each of two waits for the other; the third waits for both, and is shown where it stands."""
    meet = "touch {0}; until [ -e {1} ]; do sleep 0.01; done; echo {0}; printf rest"
    steps = [
        Step(name, ["sh", "-c", text], os.environ.copy, tmp_path, after=after)
        for name, text, after in (
            ("one", meet.format("a", "b"), ()),
            ("last", "cat a b && echo last", ("one", "other")),
            ("other", meet.format("b", "a"), ()),
        )
    ]
    steps = [steps[0], steps[2], steps[1]]
    assert run_steps(steps) == 0
    assert capfd.readouterr().out.splitlines()[:3] == ["a", "restb", "restlast"]


@pytest.mark.parametrize("what", PLANS)
def test_a_step_waits_for_steps_before_it(what: str) -> None:
    steps = PLANS[what]("container")
    known: set[str] = set()
    for step, names in predecessors(steps):
        assert known.issuperset(names)
        assert step.name not in known
        known.add(step.name)
    assert whole_minutes(steps) <= 60


def test_a_step_ends_with_the_command_that_has_begun_it() -> None:
    environment = {**os.environ, "PYTHONPATH": str(definition.CHECKOUT / "tests")}
    command = [sys.executable, "-c", STEPS]
    both = subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=both, stderr=both) as child:
        assert child.stdout
        assert child.stderr
        assert child.stdout.readline() == b"begun\n"
        child.kill()
        # The step holds the other end as well: this returns when that has ended, too.
        assert child.stderr.read().startswith(b"lab: --- step 1 of 1")


def test_a_step_that_hangs_is_ended(capfd: pytest.CaptureFixture[str]) -> None:
    hangs = Step("hangs", ["sh", "-c", "exec sleep 1000"], os.environ.copy, longest=0.005)
    assert run_steps([hangs, Step("next", ["true"], os.environ.copy)]) == 124
    said = capfd.readouterr().err
    assert "hangs: FAILED with exit status 124" in said
    assert "next: ok" in said
    assert all(step.longest >= 20 for step in PLANS["test"]("container"))


def test_bounds_are_in_seconds_of_an_idle_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pace.measure() >= 1
    monkeypatch.setattr(pace, "_last", (time.monotonic(), 2.5))
    assert pace.bound(4) == 10
    monkeypatch.setattr(pace, "_last", (time.monotonic() - 60, 2.5))
    monkeypatch.setattr(pace, "measure", lambda: 3.0)
    assert pace.bound(4) == 12


def test_what_is_tolerated_is_said_once_and_with_a_reason() -> None:
    parts = [word.part for word in TOLERATED]
    assert all(word.reason and word.dora for word in TOLERATED)
    assert all(len(word.part) >= 14 or word.is_all for word in TOLERATED)
    assert not [one for one in parts for other in parts if one != other and one in other]
    assert len(set(parts)) == len(parts)


def test_a_short_word_is_tolerated_only_as_the_whole_warning() -> None:
    assert is_tolerated("robot/source: Unknown id")
    assert not is_tolerated("robot/source: Unknown id of a unit")
    assert not is_tolerated("robot/source: it has no Unknown id")


def test_speed_is_percent() -> None:
    assert [read_speed(text) for text in (None, "", "50", "100")] == [100, 100, 50, 100]
    for text in ("0", "101", "-5", "half"):
        with pytest.raises(LabError, match="LAB_SPEED"):
            read_speed(text)


@pytest.mark.parametrize(
    ("path", "room"),
    [
        ("dora_systemd/trust/tree.py", "tests/unit/trust"),
        ("dora_systemd/names.py", "tests/unit"),
        ("cli/verbs/look/list.py", "tests/unit/cli/verbs/look"),
        ("tests/unit/verbs/test_stop.py", "tests/unit/verbs"),
        ("packaging/man/doractl.1", "tests/unit/project"),
    ],
)
def test_the_room_of_a_changed_file(path: str, room: str) -> None:
    assert find_rooms([path, ""]) == [room]


def test_the_jobs_of_the_workflow_are_all_steps_of_make_test() -> None:
    workflow = definition.read_part(definition.CHECKOUT / ".github/workflows/test.yml")
    jobs = yaml.safe_load(workflow)["jobs"]["test"]["strategy"]["matrix"]["what"]
    makefile = definition.read_part(definition.CHECKOUT / "Makefile")
    targets = re.findall(r"^([a-z-]+):", makefile, re.MULTILINE)
    assert set(jobs) <= set(targets)
    done = {step.name for job in jobs for step in PLANS[job]("container")}
    assert done >= {step.name for step in PLANS["test"]("container")}

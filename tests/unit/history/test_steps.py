"""The generator, the shrinker and the script: the same steps again, fewer of them, for people."""

import shutil
import subprocess
from itertools import pairwise

import pytest

from tests.history.found import FOUND
from tests.history.generator import generate
from tests.history.scene import PREAMBLE
from tests.history.script import format_script
from tests.history.shrink import shrink
from tests.history.steps import (
    COMMANDS,
    FAULTS,
    LABS,
    LOOK,
    NO_TARGET,
    Command,
    Fault,
    Step,
    shell_of,
)

SEEDS = range(300)


def test_a_seed_gives_the_same_steps() -> None:
    assert generate(7, 40) == generate(7, 40) != generate(8, 40)


def test_every_step_is_drawn_sooner_or_later() -> None:
    drawn = {step.what for lab in LABS for seed in SEEDS for step in generate(seed, 20, lab)}
    assert drawn == {*COMMANDS, *FAULTS, LOOK}


@pytest.mark.parametrize("lab", LABS)
def test_what_a_lab_cannot_have_is_not_drawn(lab: str) -> None:
    drawn = {step.what for seed in SEEDS for step in generate(seed, 20, lab)}
    everything: dict[str, Command | Fault] = {**COMMANDS, **FAULTS}
    assert everything.keys() - drawn == {
        name for name, one in everything.items() if lab not in one.labs
    }


def test_no_name_is_both() -> None:
    assert not COMMANDS.keys() & FAULTS.keys()


@pytest.mark.parametrize("what", FOUND)
def test_what_was_found_is_a_history(what: str) -> None:
    steps = FOUND[what]
    assert {step.what for step in steps} <= {*COMMANDS, *FAULTS, LOOK}
    assert steps[0].what in ("start", "deploy")


@pytest.mark.parametrize("seed", range(20))
def test_a_history_begins_with_a_start_and_ends_with_a_look(seed: int) -> None:
    steps = generate(seed, 15)
    assert (steps[0].what, steps[-1].what) == ("start", LOOK)
    assert len([step for step in steps if step.what != LOOK]) == 15


def test_nothing_joins_a_look() -> None:
    for seed in SEEDS:
        steps = generate(seed, 20)
        after_looks = [b for a, b in pairwise(steps) if a.what == LOOK]
        assert not any(step.is_joined for step in after_looks)


def test_the_shortest_failing_history_is_found() -> None:
    def fails(steps: list[Step]) -> bool:
        return {"kill-runner", "daemon-reexec"} <= {step.what for step in steps}

    long = [*generate(3, 20), Step("kill-runner"), Step("daemon-reexec"), Step(LOOK)]
    short = shrink(long, fails, most=200)
    assert [step.what for step in short] == ["kill-runner", "daemon-reexec", LOOK]


def test_a_shrinker_asks_no_more_than_it_may() -> None:
    asked: list[int] = []

    def fails(steps: list[Step]) -> bool:
        asked.append(len(steps))
        return False

    shrink(generate(3, 20), fails, most=5)
    assert len(asked) == 5


@pytest.mark.parametrize("what", [*COMMANDS, *FAULTS])
def test_a_step_is_shell(what: str) -> None:
    undo = FAULTS[what].undo if what in FAULTS else ""
    check_shell(f"{shell_of(what)}\n{undo}\n")


def test_a_script_is_shell() -> None:
    for seed in range(5):
        check_shell(format_script(generate(seed, 20), PREAMBLE.read_text()))


def test_a_script_undoes_a_fault_when_it_looks() -> None:
    steps = [Step("stop-source"), Step("list", is_joined=True), Step(LOOK)]
    lines = format_script(steps, "").splitlines()
    assert "wait; of history-a; { hit STOP $(node source); } &" in lines
    assert "of history-a; { doractl list; }" in lines
    assert "thaw; wait; of history-a; thaw; :" in lines


def test_a_script_does_not_wait_for_a_doractl_that_is_stopped() -> None:
    steps = [Step("stop"), Step("stop-doractl", is_joined=True), Step("list"), Step(LOOK)]
    assert "thaw; wait; of history-a; { doractl list; }" in format_script(steps, "").splitlines()


def test_the_preamble_knows_the_status_without_a_target() -> None:
    assert f"return {NO_TARGET}" in PREAMBLE.read_text()


def check_shell(text: str) -> None:
    """bash can parse it."""
    bash = shutil.which("bash") or "bash"
    done = subprocess.run([bash, "-n"], input=text, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr

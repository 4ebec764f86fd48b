"""The steps of `make test` and its parts, one after the other. All of them run, whatever fails."""

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

from lab.cache import find_cache
from lab.definition import CHECKOUT
from lab.errors import LabError, say
from lab.process import die_with_parent
from lab.venv import ensure_venv, venv_environment, write_package

LAB_PYTHON = (3, 13)
FAULTS = "tests/system/faults"
# A dataflow as a service, from start to stop: what to run after every change.
QUICK = (
    ("cell", "start", "bus", "lab"),
    ("stop", "list", "kinds", "start_refused", "start_run", "cli"),
)
# pytest's last line: "=== 3 passed, 1 skipped in 0.12s ==="
SUMMARY = re.compile(r"=+ (\d+ .* in [\d.:s ()]+) =+")
COUNTS = ("failed", "passed", "skipped", "error")
IMAGES_MINUTES = 8


@dataclass(frozen=True)
class Step:
    name: str
    command: Sequence[str]
    # Asked when the step begins: a venv that is missing is built then.
    env: Callable[[], dict[str, str]]
    cwd: Path = CHECKOUT
    # About, on two idle cores; 0 beside another step, and for less than half a minute.
    minutes: int = 0
    # The next step begins together with this one: most of the time of a test is waiting.
    with_next: bool = False


def main(arguments: Sequence[str]) -> int:
    form = os.environ.get("LAB") or "container"
    try:
        plan = PLANS[arguments[0]]
        os.environ["LAB"] = form
        return run_steps(plan(form))
    except LabError as error:
        print(error, file=sys.stderr)
        return 125
    except KeyboardInterrupt:
        return 130


@dataclass(frozen=True)
class Result:
    """How a step ended. summary: pytest's, or "done"."""

    name: str
    status: int
    summary: str


def run_steps(steps: Sequence[Step]) -> int:
    """Run them all; the worst exit status. The last line is a summary as pytest has it."""
    if len(steps) > 1:
        say_plan(steps)
    begun = time.monotonic()
    results: list[Result] = []
    early: Running | None = None
    for place, step in enumerate(steps):
        running = early or Running(step, sys.stdout)
        early = Running(steps[place + 1], spooled()) if step.with_next else None
        say(f"--- step {place + 1} of {len(steps)}: {step.name} ---")
        results.append(running.finish())
    if len(steps) > 1:
        say_results(results, time.monotonic() - begun)
    return max(result.status for result in results)


def say_plan(steps: Sequence[Step]) -> None:
    """What comes, and how long it takes."""
    minutes = sum(step.minutes for step in steps)
    say(f"{len(steps)} steps, about {minutes} minutes on two cores")
    if minutes:
        say(f"images that are missing are built first; all of them take {IMAGES_MINUTES} minutes")
    for place, step in enumerate(steps):
        known = f" (about {step.minutes} min)" if step.minutes else ""
        say(f"  {place + 1}. {step.name}{known}")


def say_results(results: Sequence[Result], seconds: float) -> None:
    """One line for each step, and one for all, as pytest writes it."""
    for result in results:
        word = f"FAILED with exit status {result.status}" if result.status else "ok"
        say(f"{result.name}: {word}; {result.summary}")
    sys.stderr.flush()
    print(f"===== {total(results)} in {seconds:.2f}s =====", flush=True)


def total(results: Sequence[Result]) -> str:
    """The sum of the summaries: "3 failed, 20 passed". A step without tests counts as one."""
    counts: Counter[str] = Counter()
    for result in results:
        found = read_counts(result.summary)
        # A step that failed without a failed test has failed all the same.
        if result.status and not found["failed"] + found["error"]:
            found["failed"] += 1
        counts += found
    known = (f"{counts[word]} {word}" for word in COUNTS if counts[word])
    return ", ".join(known) or "1 passed"


def read_counts(summary: str) -> Counter[str]:
    """The numbers of a summary; "errors" count as "error"."""
    found = re.findall(r"(\d+) ([a-z]+?)s?\b", summary.partition(" in ")[0])
    return Counter({word: int(number) for number, word in found})


class Running:
    """A step that has begun. output: where its lines go; if that is a file they are shown at the
    end, so that two steps can run at the same time."""

    def __init__(self, step: Step, output: IO[str]) -> None:
        self.step = step
        self.output = output
        is_shown = output is sys.stdout
        self.process = subprocess.Popen(
            die_with_parent(step.command, "TERM"),
            env=step.env(),
            cwd=step.cwd,
            stdout=subprocess.PIPE if is_shown else output,
            text=True,
            errors="replace",
        )

    def finish(self) -> Result:
        """How it ended, when it has ended and all is shown."""
        summary = "done"
        with self.process:
            for line in self.lines():
                print(line, end="", flush=True)
                summary = read_summary(line) or summary
        status = self.process.wait()
        return Result(self.step.name, status if status >= 0 else 128 - status, summary)

    def lines(self) -> Iterator[str]:
        if self.process.stdout is not None:
            yield from self.process.stdout
            return
        self.process.wait()
        with self.output as output:
            output.seek(0)
            yield from output


def spooled() -> IO[str]:
    """A file without a name, which goes when nobody holds it any more."""
    return TemporaryFile("w+")


def read_summary(line: str) -> str:
    found = SUMMARY.fullmatch(line.strip())
    return found[1] if found else ""


def plan_test(form: str) -> list[Step]:
    if form == "host":
        return [*plan_unit(form), *plan_system(form)]
    inside = [] if sys.version_info[:2] == LAB_PYTHON else [unit_in_lab()]
    own = [*plan_unit(form), *inside, *plan_lab(form)]
    return [*own, *plan_vm(form), packages_step(), *plan_system(form)]


def in_venv(for_system_tests: bool = False) -> dict[str, str]:
    return venv_environment(ensure_venv(find_cache(), for_system_tests))


def in_lab(form: str) -> Callable[[], dict[str, str]]:
    return lambda: {**os.environ, "LAB": form}


def plan_unit(_form: str) -> list[Step]:
    command = ["python", "-m", "pytest", "tests/unit"]
    version = ".".join(map(str, sys.version_info[:2]))
    return [Step(f"unit tests, Python {version}", command, in_venv, minutes=1)]


def unit_in_lab() -> Step:
    version = ".".join(map(str, LAB_PYTHON))
    # The linters, and Prometheus' parser, say the same of every Python; the image does without.
    without = ("project/test_linters", "decisions/views/test_prometheus")
    arguments = ["tests/unit", *(f"--ignore=tests/unit/{name}.py" for name in without)]
    return lab_step(f"unit tests, Python {version}", "container", arguments, minutes=1)


def plan_lab(_form: str) -> list[Step]:
    command = ["python", "-m", "pytest", "tests/lab"]
    return [Step("tests of the lab", command, in_venv, minutes=2)]


def plan_vm(_form: str) -> list[Step]:
    arguments = ["tests/system", "-m", "vm"]
    limits = lab_step("system tests that need limits, vm", "vm", arguments, minutes=12)
    # The machine is emulated by one processor; the packages can be built by the other.
    return [replace(build_step(), with_next=True), limits, reboot_step()]


def build_step() -> Step:
    return Step("Debian packages", ["packaging/build"], os.environ.copy)


def reboot_step() -> Step:
    """One machine for all: the packages, a reboot and a power cut with them, and their end."""
    stages = (("before",), ("after", "cut"), ("was_cut", "purge"))
    command = ["tests/lab/lab", "run", "--"]
    for place, stage in enumerate(stages):
        command += ["--reboot--"] if place else []
        command += ["pytest", *(f"tests/boot/test_{name}.py" for name in stage)]
    return Step("the packages, a reboot and a power cut, vm", command, in_lab("vm"), minutes=5)


def plan_packages(_form: str) -> list[Step]:
    """The real .deb files, as a user installs them."""
    return [build_step(), packages_step(), reboot_step()]


def packages_step() -> Step:
    return lab_step("tests of the Debian packages", "container", ["tests/deb"], minutes=4)


def plan_bookworm(_form: str) -> list[Step]:
    """The oldest systemd that the product takes, and the checkout installed there by pip."""
    return [lab_step("tests on Debian 12", "bookworm", ["tests/bookworm"], minutes=2)]


def plan_system(form: str) -> list[Step]:
    here = " and not lab" if form == "host" else ""
    arguments = ["tests/system", "-m", f"not vm and not browser{here}"]
    if form == "container":
        halves = two_halves([*arguments, f"--ignore={FAULTS}"])
        return [*plan_faults(form), *halves, *plan_browser(form)]
    if form != "host":
        return [lab_step(f"system tests, {form}", form, arguments)]
    if not Path("/run/systemd/system").is_dir():
        raise LabError("use LAB=host", "systemd is not running here; LAB=container brings its own")
    if os.geteuid() == 0:
        raise LabError("use LAB=host as root", "its tests run in user scope: be a user, not root")
    command = ["python", "-m", "pytest", *arguments]
    return [Step("system tests, this machine", command, partial(in_venv, for_system_tests=True))]


def plan_browser(_form: str) -> list[Step]:
    arguments = ["tests/system", "-m", "browser"]
    return [lab_step("status page in a browser", "browser", arguments, minutes=1)]


def plan_faults(form: str) -> list[Step]:
    """Every fault as often as ROUNDS says; a machine of its own, and nothing beside it."""
    rounds = os.environ.get("ROUNDS") or "1"
    marks = "vm" if form == "vm" else "not vm"
    command = ["tests/lab/lab", "run", "--env", f"FAULT_ROUNDS={rounds}", "--", "pytest"]
    command += [FAULTS, "-m", marks]
    return [Step(f"faults, {form}", command, in_lab(form), minutes=3 * int(rounds))]


def plan_history(_form: str) -> list[Step]:
    """Histories from SEED on, for HOURS or one; what breaks one is made shorter and printed."""
    asked = ("--seed", "SEED", "1"), ("--steps", "STEPS", "40"), ("--hours", "HOURS", "0")
    chosen = [word for flag, name, usual in asked for word in (flag, os.environ.get(name) or usual)]
    kept = ["--out", "/out"] if os.environ.get("LAB_OUT") else []
    command = ["tests/lab/lab", "run", "--", "python", "-m", "tests.history", "--shrink"]
    return [Step("histories", [*command, *chosen, *kept], in_lab("container"))]


def plan_fuzz(_form: str) -> list[Step]:
    seconds = os.environ.get("FUZZ_SECONDS") or "120"
    return [Step("fuzzing", ["python", "-m", "tests.fuzz", seconds], in_venv)]


def plan_quick(_form: str) -> list[Step]:
    """The heart of the system tests, two containers at the same time."""
    first, second = (
        quick_step([f"tests/system/test_{name}.py" for name in half]) for half in QUICK
    )
    return [replace(first, with_next=True), second]


def quick_step(files: Sequence[str]) -> Step:
    return lab_step("quick system tests", "container", [*files, "-m", "not vm"])


def two_halves(arguments: Sequence[str]) -> list[Step]:
    """Two containers at the same time; a test that measures or floods has its half for itself."""
    first = lab_step("system tests, first half", "container", [*arguments, "--half=1"])
    second = lab_step("system tests, second half", "container", [*arguments, "--half=2"], minutes=8)
    return [replace(first, with_next=True), second]


def lab_step(name: str, form: str, arguments: Sequence[str], minutes: int = 0) -> Step:
    command = ["tests/lab/lab", "run", "--", "pytest", *arguments]
    return Step(name, command, in_lab(form), minutes=minutes)


def plan_lint(_form: str) -> list[Step]:
    venv = ensure_venv(find_cache())
    config = f"--config-file={CHECKOUT / 'pyproject.toml'}"
    sources = ["dora_systemd", "lab"]
    return [
        Step("ruff", ["ruff", "check", "."], in_venv),
        Step("mypy", ["mypy", config, *sources], in_venv, write_package(venv)),
    ]


PLANS: dict[str, Callable[[str], list[Step]]] = {
    "test": plan_test,
    "unit": plan_unit,
    "system": plan_system,
    "quick": plan_quick,
    "faults": plan_faults,
    "history": plan_history,
    "fuzz": plan_fuzz,
    "lab": plan_lab,
    "vm": plan_vm,
    "packages": plan_packages,
    "bookworm": plan_bookworm,
    "browser": plan_browser,
    "lint": plan_lint,
}

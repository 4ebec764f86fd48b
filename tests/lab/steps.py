"""Carries out the steps of `make test` and its parts. All of them run, whatever fails.

A step begins when the steps that it names have ended, so some run at the same time: most of the
time of a test is waiting. What they print is shown one step after the other, in the plan's order.
"""

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryFile
from threading import Event, Thread

from lab.cgroup import USAGE
from lab.definition import CHECKOUT
from lab.errors import LabError, say
from lab.process import die_with_parent

# pytest's last line: "=== 3 passed, 1 skipped in 0.12s ==="
SUMMARY = re.compile(r"=+ (\d+ .* in [\d.:s ()]+) =+")
# The name of a test that failed, and a line that shows why.
TEST = re.compile(r"_+ (.+) _+")
WHY = re.compile(r"E   +\S.*|(FAILED|ERROR) \S.*")
WHY_OF_A_TEST, WHY_OF_A_STEP = 8, 30
COUNTS = ("failed", "passed", "skipped", "error")
IMAGES_MINUTES = 8
LOOK_SECONDS = 0.2


@dataclass(frozen=True)
class Step:
    """after: names of earlier steps that must have ended; None: the step before it in the plan."""

    name: str
    command: Sequence[str]
    # Asked when the step begins: a venv that is missing is built then.
    env: Callable[[], dict[str, str]]
    cwd: Path = CHECKOUT
    # About, on two cores that have nothing else to do; 0 for less than half a minute.
    minutes: int = 0
    after: tuple[str, ...] | None = None
    # Minutes after which it is ended, because a machine in it hangs; 0: never.
    longest: float = 0


@dataclass(frozen=True)
class Result:
    """How a step ended. summary: pytest's, or "done". cpu: seconds of processor time, of all that
    it has started and waited for, and of its containers. faults: lines about what failed."""

    name: str
    status: int
    summary: str
    cpu: float = 0.0
    faults: tuple[str, ...] = ()


def run_steps(steps: Sequence[Step]) -> int:
    """Run them all; the worst exit status. The last line is a summary as pytest has it.

    Raises LabError.
    """
    if len(steps) > 1:
        say_plan(steps)
    begun = time.monotonic()
    running = begin(steps)
    results: list[Result] = []
    for place, one in enumerate(running):
        now = (time.monotonic() - begun) / 60
        say(f"--- step {place + 1} of {len(steps)}, {now:.0f} min: {one.step.name} ---")
        results.append(one.finish())
    if len(steps) > 1:
        say_results(results, time.monotonic() - begun)
    return max(result.status for result in results)


def begin(steps: Sequence[Step]) -> list["Running"]:
    """All of them; each waits for the steps that it names."""
    running: dict[str, Running] = {}
    for step, names in predecessors(steps):
        running[step.name] = Running(step, [running[name] for name in names])
    return list(running.values())


def predecessors(steps: Sequence[Step]) -> Iterator[tuple[Step, tuple[str, ...]]]:
    """Each step, and the names of those that it waits for."""
    before: tuple[str, ...] = ()
    for step in steps:
        yield step, before if step.after is None else step.after
        before = (step.name,)


def whole_minutes(steps: Sequence[Step]) -> int:
    """How long the steps take, of which some run at the same time."""
    ends: dict[str, int] = {}
    for step, names in predecessors(steps):
        ends[step.name] = step.minutes + max((ends[name] for name in names), default=0)
    return max(ends.values())


def say_plan(steps: Sequence[Step]) -> None:
    """What comes, and how long it takes."""
    minutes = whole_minutes(steps)
    say(f"{len(steps)} steps, about {minutes} minutes on two cores")
    if minutes:
        say(f"images that are missing are built first; all of them take {IMAGES_MINUTES} minutes")
    for place, step in enumerate(steps):
        known = f" (about {step.minutes} min)" if step.minutes else ""
        say(f"  {place + 1}. {step.name}{known}")


def say_results(results: Sequence[Result], seconds: float) -> None:
    """One line for each step, what failed, and one line for all, as pytest writes it.

    A CI may show only the end of a long output.
    """
    for result in results:
        word = f"FAILED with exit status {result.status}" if result.status else "ok"
        used = f"{result.cpu:.0f} s of processor time"
        say(f"{result.name}: {word}; {result.summary}; {used}")
    for result in results:
        for line in result.faults:
            say(f"{result.name}: {line}")
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
    """A step, from now on. What it prints goes to a file without a name."""

    def __init__(self, step: Step, before: Sequence["Running"]) -> None:
        self.step = step
        self._before = before
        self._output = TemporaryFile("w+")  # noqa: SIM115 - open as long as the step
        self._status = 0
        self._cpu = 0.0
        self._error: LabError | None = None
        self._has_ended = Event()
        # The kernel tells the step when this thread dies, so it stays until the step has ended.
        Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        try:
            for one in self._before:
                one._has_ended.wait()
            self._status = self._call()
        except LabError as error:
            self._error = error
        finally:
            self._has_ended.set()

    def _call(self) -> int:
        limit = ["timeout", "--foreground", "--kill-after=1m", f"{self.step.longest}m"]
        words = [*limit, *self.step.command] if self.step.longest else self.step.command
        command = die_with_parent(words, "TERM")
        with NamedTemporaryFile("r") as used:
            env = {**self.step.env(), USAGE: used.name}
            process = subprocess.Popen(command, env=env, cwd=self.step.cwd, stdout=self._output)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            self._cpu = usage.ru_utime + usage.ru_stime + sum(map(float, used))
        return process.returncode

    def finish(self) -> Result:
        """How it ended, when it has ended and all is shown. Raises LabError."""
        summary, line, faults = "done", "", Faults()
        for part in self._parts():
            print(part, end="", flush=True)
            line += part
            if line.endswith("\n"):
                faults.read(line.rstrip())
                summary, line = read_summary(line) or summary, ""
        if self._error:
            raise self._error
        status = self._status
        status = status if status >= 0 else 128 - status
        return Result(self.step.name, status, summary, self._cpu, faults.found if status else ())

    def _parts(self) -> Iterator[str]:
        """What it prints, as it comes: lines, and beginnings of lines."""
        # Opened anew, because the step writes where its own descriptor stands.
        with (
            self._output,
            Path(f"/proc/self/fd/{self._output.fileno()}").open(errors="replace") as shown,
        ):
            has_ended = False
            while not has_ended:
                has_ended = self._has_ended.wait(LOOK_SECONDS)
                yield from shown


class Faults:
    """Which tests failed and why, of the lines that pytest prints."""

    def __init__(self) -> None:
        self._found: list[str] = []
        self._test = ""
        self._left = 0

    @property
    def found(self) -> tuple[str, ...]:
        return tuple(self._found[-WHY_OF_A_STEP:])

    def read(self, line: str) -> None:
        """Take a line. Only the first lines about a test are kept."""
        if named := TEST.fullmatch(line):
            self._test, self._left = named[1], WHY_OF_A_TEST
        elif (why := WHY.fullmatch(line)) and (self._left or why[1]):
            self._found += [self._test] if self._test else []
            self._found.append(line)
            self._test, self._left = "", max(self._left - 1, 0)


def read_summary(line: str) -> str:
    found = SUMMARY.fullmatch(line.strip())
    return found[1] if found else ""

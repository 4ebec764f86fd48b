"""The table of faults, as often as wanted, and what came of it."""

import os
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator

import pytest

from dora_systemd.decisions.views.dataflows import format_table
from tests.system.cells import run
from tests.system.faults.table import TABLE, Fault

CLOCK_SECONDS = 60
ROUNDS = int(os.environ.get("FAULT_ROUNDS") or "1")


class Recoveries:
    """How long recovery took, in seconds, by fault; and how often a fault was tried and passed."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, list[float]] = defaultdict(list)
        self._passed: defaultdict[str, int] = defaultdict(int)
        self._rounds: defaultdict[str, int] = defaultdict(int)

    def note(self, fault: str, seconds: float) -> None:
        """The outcome was there after so many seconds."""
        self._seconds[fault].append(seconds)

    def count(self, fault: str, has_passed: bool) -> None:
        """A round of a fault is over."""
        self._rounds[fault] += 1
        self._passed[fault] += has_passed

    def rows(self) -> list[list[str]]:
        """Fault, outcome, rounds, passed, median, maximum, bound."""
        return [
            [
                *(fault.name, fault.outcome.value),
                *(str(self._rounds[fault.name]), str(self._passed[fault.name])),
                *(f"{function(self._seconds[fault.name] or [0.0]):.1f}"
                  for function in (statistics.median, max)),
                f"{fault.seconds:g}",
            ]
            for fault in TABLE
            if fault.name in self._rounds
        ]  # fmt: skip


RECOVERIES = Recoveries()


@pytest.fixture
def recoveries() -> Recoveries:
    return RECOVERIES


@pytest.fixture(autouse=True)
def clock() -> Iterator[None]:
    """What comes after a fault of the clock finds it as it was."""
    offset = time.time() - time.monotonic()
    yield
    if abs(time.time() - time.monotonic() - offset) > CLOCK_SECONDS:
        run("date", f"--set=@{time.monotonic() + offset:.3f}")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "fault" in metafunc.fixturenames:
        rows = [_row(fault, number) for number in range(ROUNDS) for fault in TABLE]
        metafunc.parametrize("fault", rows)


def _row(fault: Fault, number: int) -> object:
    marks = [pytest.mark.lab, pytest.mark.warns(*fault.warns), *([pytest.mark.vm] * fault.vm)]
    return pytest.param(fault, marks=marks, id=f"{fault.name}-{number}" if number else fault.name)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item):  # type: ignore[no-untyped-def]
    report = (yield).get_result()
    fault = getattr(item, "callspec", None) and item.callspec.params.get("fault")  # type: ignore[attr-defined]
    if isinstance(fault, Fault):
        failed = item.stash.get(FAILED, False) or report.failed
        item.stash[FAILED] = failed
        if report.when == "teardown":
            RECOVERIES.count(fault.name, not failed)


FAILED = pytest.StashKey[bool]()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    rows = RECOVERIES.rows()
    if rows:
        header = ("FAULT", "OUTCOME", "ROUNDS", "PASSED", "MEDIAN s", "MAX s", "BOUND s")
        terminalreporter.section("faults")
        terminalreporter.write_line(format_table(header, rows))

"""Rounds: ours and the rivals in turns, on the same machine, so that only the ratio counts."""

import json
import math
import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

OURS = "doractl"
"""The contestant that all others are compared with."""

ZENOH_MS = 300
"""The least difference of a round in which dora has waited for zenoh to one in which it has not."""

EMPTY = "empty Pythons"
"""A unit of goals: `python3 -c ''` in startup.py. Ratios to it hold on a slower machine, too."""

OUT = Path("/out")
"""Where `LAB_OUT=DIR tests/lab/lab run` takes files out of the lab."""


@dataclass(frozen=True)
class Figure:
    """One line of a table. values: of each contestant all rounds, in `unit`, in their order.

    at: how many, or how large, where several figures make a curve.
    """

    what: str
    unit: str
    values: dict[str, list[float]]
    goal: str = ""
    at: int | None = None

    def median(self, name: str = OURS, rounds: Sequence[int] = ()) -> float:
        """Of all rounds of a contestant, or of some of them."""
        values = self.values[name]
        return statistics.median(values[one] for one in rounds or range(len(values)))

    def ratios(self, rival: str) -> list[float]:
        """Ours to a rival's, round by round; infinite where that is nothing."""
        pairs = zip(self.values[OURS], self.values[rival], strict=True)
        return [ours / other if other else math.inf for ours, other in pairs]

    def moods(self, name: str) -> list[list[int]]:
        """The rounds of a contestant: the quick ones and the slow ones, or all of them.

        Bare dora waits half a second for zenoh, or does not, by chance. Its median says which of
        the two happened more often.
        """
        values = self.values[name]
        order = sorted(range(len(values)), key=values.__getitem__)
        steps = [(values[b] - values[a], values[b] > values[a] * 1.5) for a, b in pairwise(order)]
        widest, is_wide = max(steps, default=(0.0, False))
        if self.unit != "ms" or widest < ZENOH_MS or not is_wide:
            return [order]
        cut = steps.index((widest, is_wide)) + 1
        return [order[:cut], order[cut:]]

    @property
    def rivals(self) -> list[str]:
        """All contestants but ours."""
        return [name for name in self.values if name != OURS]


@dataclass(frozen=True)
class Record:
    """What a benchmark has measured, when, and where. load: before and after, of one minute."""

    name: str
    date: str
    rounds: int
    machine: dict[str, Any]
    load: tuple[float, float]
    figures: tuple[Figure, ...]


Measure = Callable[[], float]


def take_turns(contestants: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """What each gives, `rounds` times, one after the other; each round begins with another one."""
    values: dict[str, list[T]] = {name: [] for name in contestants}
    names = list(contestants)
    for number in range(rounds):
        first = number % len(names)
        for name in (*names[first:], *names[:first]):
            values[name].append(contestants[name]())
    return values


def alternate(
    what: str, unit: str, contestants: Mapping[str, Measure], rounds: int, **about: Any
) -> Figure:
    """Measure all in turns."""
    return shown(Figure(what, unit, take_turns(contestants, rounds), **about))


def shown(figure: Figure) -> Figure:
    """The figure, for whoever watches."""
    print(format_line(figure), flush=True)
    return figure


def format_line(figure: Figure) -> str:
    """A figure for whoever watches: medians and ratios."""
    of_rivals = (
        f"{name} {figure.median(name):.4g} ({statistics.median(figure.ratios(name)):.2f})"
        for name in figure.rivals
    )
    ours = f"{figure.what}: {OURS} {figure.median():.4g} {figure.unit}"
    return "; ".join((ours, *of_rivals))


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    fields = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((one.partition(":")[2].strip() for one in fields if "model name" in one), "")
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "processor": model or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gib": round(pages / 2**30),
        "linux": platform.release(),
        "python": platform.python_version(),
        "where": os.environ.get("LAB", "host"),
    }


def load() -> float:
    """How many processes have wanted to run, on average, in the last minute."""
    return round(os.getloadavg()[0], 2)


def keep(name: str, measure: Callable[[int], Sequence[Figure]], rounds: int) -> None:
    """Measure, and write all rounds as JSON to where the lab takes it out, else print them."""
    before = load()
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M")
    figures = tuple(measure(rounds))
    record = Record(name, date, rounds, machine(), (before, load()), figures)
    if OUT.is_dir():
        (OUT / f"{name}.json").write_text(format_record(record))


def format_record(record: Record) -> str:
    """As JSON with a line for each contestant's rounds; five digits are more than there are."""
    document = asdict(record)
    figures = document.pop("figures")
    for figure in figures:
        for name, found in figure["values"].items():
            figure["values"][name] = [float(f"{value:.5g}") for value in found]
    head = json.dumps(document, indent=1).removesuffix("\n}")
    lines = ",\n  ".join(json.dumps(figure) for figure in figures)
    return f'{head},\n "figures": [\n  {lines}\n ]\n}}\n'


def parse_record(text: str) -> Record:
    """The exact inverse of format_record."""
    document = json.loads(text)
    figures = tuple(Figure(**figure) for figure in document.pop("figures"))
    before, after = document.pop("load")
    return Record(**document, load=(before, after), figures=figures)

"""Rounds: ours and a rival's in turns, on the same machine, so that only the ratio counts."""

import json
import os
import platform
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

OUT = Path("/out")
"""Where `LAB_OUT=DIR tests/lab/lab run` takes files out of the lab."""


@dataclass(frozen=True)
class Figure:
    """One line of a table. ours, rival: all rounds, in `unit`, in the order they were measured."""

    what: str
    rival_name: str
    unit: str
    ours: list[float]
    rival: list[float]

    @property
    def ratios(self) -> list[float]:
        """Of each round."""
        return [one / other for one, other in zip(self.ours, self.rival, strict=True)]

    def line(self) -> str:
        """The figure as a line of a Markdown table: medians, their ratio, its spread."""
        ratio = statistics.median(self.ratios)
        spread = f"{min(self.ratios):.2f} to {max(self.ratios):.2f}"
        ours, rival = statistics.median(self.ours), statistics.median(self.rival)
        values = f"{ours:,.4g} {self.unit} | {rival:,.4g} {self.unit}"
        return f"| {self.what} | {values} ({self.rival_name}) | {ratio:.2f} | {spread} |"


def alternate(
    what: str,
    unit: str,
    ours: Callable[[], float],
    rival_name: str,
    rival: Callable[[], float],
    rounds: int,
) -> Figure:
    """Measure both, one after the other, `rounds` times; who begins changes."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for number in range(rounds):
        for is_ours in (True, False) if number % 2 else (False, True):
            found[is_ours].append((ours if is_ours else rival)())
    return Figure(what, rival_name, unit, found[True], found[False])


def report(name: str, figures: list[Figure]) -> None:
    """Print a Markdown table, and keep all rounds as JSON where the lab takes it out."""
    print("| what | ours | rival | ratio, median | spread |")
    print("|---|---|---|---|---|")
    for figure in figures:
        print(figure.line())
    machine = {"cores": os.cpu_count(), "machine": platform.machine(), "linux": platform.release()}
    document = {"machine": machine, "figures": [asdict(one) for one in figures]}
    if OUT.is_dir():
        (OUT / f"{name}.json").write_text(json.dumps(document, indent=1))

"""A few rounds of the short ones, beside the stored figures.  `python -m benchmarks.quick`

What is compared are ratios to a rival, so that it may be another machine, or a busy one.
"""

import statistics
import sys
from collections.abc import Callable, Iterable

from benchmarks import logs, recovery, start, startup, stop
from benchmarks.report import read_records
from benchmarks.rounds import Figure

WORSE = "; worse by more than its spread"

PARTS: dict[str, Callable[[], list[Figure]]] = {
    "start": lambda: start.measure(3, (2,)),
    "stop": lambda: stop.measure(2),
    "recovery": lambda: recovery.measure(1),
    "startup": lambda: startup.measure(5),
    "logs": lambda: logs.measure(1, want_all=False),
}


def format_change(now: Figure, stored: Figure, rival: str) -> str:
    """A line: the ratio then and now, what has become of it, and if it is worse than it ever was.

    Worse is outside the spread of the stored rounds, on the side that counts.
    """
    ratios = stored.ratios(rival)
    before, after = statistics.median(ratios), statistics.median(now.ratios(rival))
    is_worse = after < min(ratios) if now.unit.endswith("/s") else after > max(ratios)
    change = f"{before:.2f} stored, {after:.2f} now, {after / before:.2f} ×"
    return f"{now.what}, to {rival}: {change}{WORSE if is_worse else ''}"


def compare(measured: Iterable[Figure], stored: Iterable[Figure]) -> list[str]:
    """A line for each rival of each figure that is stored."""
    known = {figure.what: figure for figure in stored}
    return [
        format_change(now, known[now.what], rival)
        for now in measured
        if now.what in known
        for rival in now.rivals
        if rival in known[now.what].values
    ]


def main(names: list[str]) -> None:
    """Measure, then print all lines together, those that became worse at the end."""
    records = read_records()
    lines: list[str] = []
    for name in names or PARTS:
        stored = records[name].figures if name in records else ()
        lines += compare(PARTS[name](), stored)
    print("\n".join(("", *sorted(lines, key=lambda line: line.endswith(WORSE)))))


if __name__ == "__main__":
    main(sys.argv[1:])

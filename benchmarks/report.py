"""Writes the tables of both READMEs and the plots from data/*.json.  `python -m benchmarks.report`

Nothing between its markers is typed by hand.
"""

import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.plots import bar_chart, line_chart
from benchmarks.rounds import OURS, Figure, Record, parse_record

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
FULL = HERE / "README.md"
SHORT = HERE.parent / "README.md"
BEGIN = "<!-- benchmarks: written by python -m benchmarks.report -->"
END = "<!-- end of benchmarks -->"

TITLES = {
    "start": "Start",
    "stop": "Stop and restart",
    "recovery": "Recovery",
    "startup": "The command itself",
    "many": "Many dataflows",
    "gateway": "The gateway beside many dataflows",
    "cost": "Memory and idle CPU",
    "fleet": "Idle dataflows, and a boot",
    "logs": "Log path",
    "messages": "Messages",
    "reload": "Hot reload",
    "deploy": "Deploy",
    "owes": "Owed outputs",
    "recorder": "The recorder",
    "machines": "Between machines",
    "spread": "Start over two machines",
    "platform-bookworm": "The packages on Debian 12",
    "platform-container": "The packages on Debian 13",
    "platform-forky": "The packages on the next Debian",
}
"""The records in their order."""

PLOTS = {"start": bar_chart, "many": line_chart}

HIGHLIGHTS = (
    ("start", "start to all of 2 nodes ready", "dora run"),
    ("start", "start to all of 20 nodes ready", "dora run"),
    ("stop", "stop until nothing is left", "dora up, start"),
    ("recovery", "kill -9 until messages flow again", "systemd-run dora run"),
    ("startup", "`list` with no dataflow", "dora"),
    ("many", "`list` of 50", "dora"),
    ("cost", "private memory, with dora's own processes", "dora up, start"),
    ("cost", "CPU when idle, beside dora", "supervisord"),
    ("logs", "lines a second into the journal, one node", "writes to journald itself"),
    ("messages", "latency of 41 kB", "dora up, start"),
    ("messages", "latency of 41 kB", "dora run"),
)
"""Lines of the short table: record, figure, rival."""


def read_records(directory: Path = DATA) -> dict[str, Record]:
    """The stored ones, in the order of TITLES."""
    paths = {name: directory / f"{name}.json" for name in TITLES}
    return {name: parse_record(path.read_text()) for name, path in paths.items() if path.exists()}


def format_number(value: float) -> str:
    """Three digits, and no exponent."""
    digits = 0 if abs(value) >= 100 else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits}f}"


MANY = 20
"""From so many rounds on, the interval of confidence says more than the spread."""


def format_ratio(ratios: Sequence[float]) -> str:
    """The median, and from where to where they go; of many the mean and its interval at 95 %."""
    if len(ratios) >= MANY and all(math.isfinite(one) and one > 0 for one in ratios):
        return "**{:.2f}**, 95 %: {:.2f}–{:.2f}".format(*confidence(ratios))
    middle, low, high = statistics.median(ratios), min(ratios), max(ratios)
    spread = "" if len(ratios) == 1 else f", {low:.2f}–{high:.2f}"
    return f"**{middle:.2f}**{spread}"


def confidence(ratios: Sequence[float]) -> tuple[float, float, float]:
    """The geometric mean, and the ends of its interval of 95 %, for at least MANY ratios."""
    logs = [math.log(one) for one in ratios]
    middle, half = statistics.mean(logs), 1.96 * statistics.stdev(logs) / math.sqrt(len(logs))
    return math.exp(middle), math.exp(middle - half), math.exp(middle + half)


def format_cell(figure: Figure, name: str) -> str:
    """A contestant's median; with ours to it, if it is a rival."""
    if name not in figure.values:
        return "–"
    if name == OURS:
        return format_median(figure, name)
    moods, ratios = figure.moods(name), format_ratios(figure, name)
    values = (format_median(figure, name, rounds) for rounds in moods)
    counts = (f", {count}" if count else "" for count in format_counts(moods))
    cells = zip(values, ratios, counts, strict=True)
    return "; ".join(f"{value} ({ratio}{count})" for value, ratio, count in cells)


def format_median(figure: Figure, name: str, rounds: Sequence[int] = ()) -> str:
    """The median of some rounds, or of all, with its unit."""
    return f"{format_number(figure.median(name, rounds))} {figure.unit}".strip()


def format_counts(moods: Sequence[Sequence[int]]) -> list[str]:
    """How many rounds each mood has, such as "2 of 7"; "" if there is one mood."""
    total = sum(map(len, moods))
    return [f"{len(one)} of {total}" if len(one) < total else "" for one in moods]


def format_ratios(figure: Figure, rival: str) -> list[str]:
    """Ours to a rival, for its quick rounds and its slow ones if there are both."""
    ratios = figure.ratios(rival)
    return [format_ratio([ratios[one] for one in rounds]) for rounds in figure.moods(rival)]


def format_table(figures: Sequence[Figure]) -> str:
    """Figures with the same rivals, or with fewer of them than the first one."""
    names = [OURS, *figures[0].rivals]
    lines = [("", *names, "goal"), ("---",) * (len(names) + 2)]
    for figure in figures:
        lines.append((figure.what, *(format_cell(figure, name) for name in names), figure.goal))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def group_figures(figures: Iterable[Figure]) -> list[list[Figure]]:
    """In their order, a new table wherever there is a rival that the one before does not have."""
    tables: list[list[Figure]] = []
    for figure in figures:
        if tables and set(figure.rivals) <= set(tables[-1][0].rivals):
            tables[-1].append(figure)
        else:
            tables.append([figure])
    return tables


def format_machine(record: Record) -> str:
    """What it was measured on."""
    about = record.machine
    return (
        f"{about['processor']}, {about['cores']} cores, {about['memory_gib']} GiB, "
        f"Linux {about['linux']}, Python {about['python']}"
    )


def format_record(record: Record) -> str:
    """One section."""
    before, after = record.load
    times = f"{record.rounds} rounds" if record.rounds > 1 else "1 round"
    when = f"{record.date} UTC, {times}, load {before:.1f} before and {after:.1f} after."
    tables = [format_table(one) for one in group_figures(record.figures)]
    plot = [f"![{TITLES[record.name]}](data/{record.name}.svg)"] * (record.name in PLOTS)
    return "\n\n".join((f"### {TITLES[record.name]}", when, *tables, *plot))


def format_full(records: dict[str, Record]) -> str:
    """All that was measured."""
    machines = sorted({format_machine(record) for record in records.values()})
    return "\n\n".join(
        (f"Measured on: {'; '.join(machines)}.", *map(format_record, records.values()))
    )


def format_short(records: dict[str, Record]) -> str:
    """The lines that README.md has."""
    lines = ["| | doractl | compared with | ratio, spread |", "|---|---|---|---|"]
    for name, what, rival in HIGHLIGHTS:
        figures = records[name].figures if name in records else ()
        for figure in (one for one in figures if one.what == what and rival in one.values):
            ours = format_median(figure, OURS)
            moods = figure.moods(rival)
            medians = (format_median(figure, rival, one) for one in moods)
            pairs = zip(medians, format_counts(moods), strict=True)
            theirs = "; ".join(f"{text} ({count})" if count else text for text, count in pairs)
            ratio = "; ".join(format_ratios(figure, rival))
            lines.append(f"| {what} | {ours} | {rival}: {theirs} | {ratio} |")
    return "\n".join(lines)


def between_markers(document: str, text: str) -> str:
    """The document with `text` where its markers are."""
    head, _, rest = document.partition(BEGIN)
    _, end, tail = rest.partition(END)
    assert end, f"no {BEGIN} ... {END}"
    return f"{head}{BEGIN}\n{text}\n{END}{tail}"


def make_files(records: dict[str, Record]) -> dict[Path, str]:
    """Every file that is written, and its text."""
    files = {
        FULL: between_markers(FULL.read_text(), format_full(records)),
        SHORT: between_markers(SHORT.read_text(), format_short(records)),
    }
    for name, plot in PLOTS.items():
        if name in records:
            curves = [one for one in records[name].figures if one.at is not None]
            files[DATA / f"{name}.svg"] = plot(TITLES[name], curves)
    return files


if __name__ == "__main__":
    for path, text in make_files(read_records()).items():
        path.write_text(text)

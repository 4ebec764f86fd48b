"""Benchmarks are no tests, but their arithmetic is tested, and that nobody types a figure."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial

import pytest

from benchmarks import machines
from benchmarks.messages import COUNT, SIZES, Message, name_of, results
from benchmarks.plots import bar_chart, ceiling, line_chart
from benchmarks.quick import WORSE, compare
from benchmarks.report import (
    BEGIN,
    END,
    between_markers,
    format_full,
    format_number,
    format_ratio,
    format_short,
    format_table,
    group_figures,
    make_files,
    read_records,
)
from benchmarks.rounds import Figure, Record, alternate, format_record, parse_record

FIGURE = Figure(
    "start to all of 2 nodes ready",
    "ms",
    {"doractl": [110.0, 120.0, 180.0], "dora run": [100.0, 100.0, 100.0], "pm2": [220.0] * 3},
    at=2,
)
MACHINE = {
    **{"processor": "Z80", "cores": 1, "memory_gib": 1},
    **{"linux": "6.1", "python": "3.13.5", "where": "container"},
}
RECORD = Record("start", "2026-11-21 10:00", 3, MACHINE, (0.25, 1.5), (FIGURE,))


def test_ratio_is_of_rounds_not_of_medians() -> None:
    figure = Figure("x", "ms", {"doractl": [1.0, 30.0, 200.0], "pm2": [2.0, 20.0, 50.0]})
    assert figure.ratios("pm2") == [0.5, 1.5, 4.0]
    assert figure.median() == 30
    assert figure.rivals == ["pm2"]


def test_each_round_begins_with_another_contestant() -> None:
    order: list[str] = []

    def measured(name: str) -> float:
        order.append(name)
        return float(len(order))

    names = ("doractl", "b", "c")
    contestants = {name: partial(measured, name) for name in names}
    figure = alternate("x", "ms", contestants, 3)
    assert order == ["doractl", "b", "c", "b", "c", "doractl", "c", "doractl", "b"]
    assert figure.values == {"doractl": [1, 6, 8], "b": [2, 4, 9], "c": [3, 5, 7]}


def test_record_survives_its_file() -> None:
    assert parse_record(format_record(RECORD)) == RECORD


def test_record_keeps_five_digits() -> None:
    figure = replace(FIGURE, values={"doractl": [123456.789], "pm2": [0.00123456]})
    kept = parse_record(format_record(replace(RECORD, figures=(figure,))))
    assert kept.figures[0].values == {"doractl": [123460.0], "pm2": [0.0012346]}


@pytest.mark.parametrize(
    ("value", "written"), [(61234.5, "61,234"), (99.94, "99.9"), (1.234, "1.23"), (0.0, "0.00")]
)
def test_numbers(value: float, written: str) -> None:
    assert format_number(value) == written


def test_ratio_has_a_spread_only_of_several_rounds() -> None:
    assert format_ratio([1.1, 1.8, 1.2]) == "**1.20**, 1.10–1.80"
    assert format_ratio([1.1]) == "**1.10**"


def test_ratio_of_many_rounds_has_an_interval_of_confidence() -> None:
    assert format_ratio([0.98, 1.02] * 20) == "**1.00**, 95 %: 0.99–1.01"
    assert format_ratio([0.98, float("inf")] * 20) == "**inf**, 0.98–inf"


def test_table() -> None:
    other = Figure("5 nodes", "ms", {"doractl": [1.5], "pm2": [3.0]}, goal="less")
    assert format_table([FIGURE, other]).splitlines() == [
        "|  | doractl | dora run | pm2 | goal |",
        "| --- | --- | --- | --- | --- |",
        "| start to all of 2 nodes ready | 120 ms | 100 ms (**1.20**, 1.10–1.80) "
        "| 220 ms (**0.55**, 0.50–0.82) |  |",
        "| 5 nodes | 1.50 ms | – | 3.00 ms (**0.50**) | less |",
    ]


def test_the_two_times_of_dora_are_apart() -> None:
    values = {"doractl": [400.0, 400.0, 420.0], "dora run": [680.0, 200.0, 700.0]}
    moody = replace(FIGURE, values=values)
    assert moody.moods("dora run") == [[1], [0, 2]]
    assert moody.moods("doractl") == [[0, 1, 2]]
    assert "| 200 ms (**2.00**, 1 of 3); 690 ms (**0.59**, 0.59–0.60, 2 of 3) |" in format_table(
        [moody]
    )
    record = replace(RECORD, figures=(moody,))
    assert format_short({"start": record}).splitlines()[2:] == [
        "| start to all of 2 nodes ready | 400 ms | dora run: 200 ms (1 of 3); 690 ms (2 of 3) "
        "| **2.00**; **0.59**, 0.59–0.60 |"
    ]


@pytest.mark.parametrize(
    ("unit", "values"),
    [("1/s", [200.0, 700.0]), ("ms", [200.0, 490.0]), ("ms", [900.0, 1300.0]), ("ms", [700.0])],
)
def test_other_differences_are_the_spread(unit: str, values: list[float]) -> None:
    figure = Figure("x", unit, {"doractl": values, "pm2": values})
    assert len(figure.moods("pm2")) == 1


def test_a_new_rival_begins_a_new_table() -> None:
    fewer = replace(FIGURE, values={"doractl": [1.0], "pm2": [1.0]})
    other = replace(FIGURE, values={"doractl": [1.0], "journalctl": [1.0]})
    assert group_figures([FIGURE, fewer, other]) == [[FIGURE, fewer], [other]]


def test_short_table_leaves_out_what_was_not_measured() -> None:
    lines = format_short({"start": RECORD}).splitlines()
    assert lines[2:] == [
        "| start to all of 2 nodes ready | 120 ms | dora run: 100 ms | **1.20**, 1.10–1.80 |"
    ]


def test_full_report_says_where_and_when() -> None:
    written = format_full({"start": RECORD})
    assert "Measured on: Z80, 1 cores, 1 GiB, Linux 6.1, Python 3.13.5." in written
    assert "2026-11-21 10:00 UTC, 3 rounds, load 0.2 before and 1.5 after." in written


def test_only_what_is_between_the_markers_changes() -> None:
    document = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    assert between_markers(document, "new") == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    with pytest.raises(AssertionError):
        between_markers("no marker", "new")


def test_axis_ends_above_the_highest_value() -> None:
    assert ceiling([FIGURE]) == 300
    assert ceiling([replace(FIGURE, values={"doractl": [0.5]})]) == 1


@pytest.mark.parametrize("chart", [bar_chart, line_chart])
def test_charts_are_xml_with_every_name(chart: object) -> None:
    assert callable(chart)
    drawn = ET.fromstring(chart("a < b", [FIGURE, replace(FIGURE, at=5)]))
    words = [one.text for one in drawn.iter("{http://www.w3.org/2000/svg}text")]
    assert {"a < b, ms", "doractl", "dora run", "pm2", "2", "5"} <= set(words)


def messages_of(size: int, delay_us: int, gap_us: int) -> list[Message]:
    """The pattern for one size; those without pause come every gap_us."""
    calm = [(size, 0, n * 10**7, n * 10**7 + delay_us * 1000) for n in range(COUNT)]
    return calm + [(size, 1, 0, n * gap_us * 1000) for n in range(COUNT)]


def test_latency_is_of_the_calm_messages_and_throughput_of_the_fast_ones() -> None:
    messages = [one for size in SIZES for one in messages_of(size, 500, 100)]
    found = results([(3, 0, 0, 10**12), *messages])
    assert found["latency of 4 MB"] == 500
    assert found["throughput of 8 B messages"] == pytest.approx(10_000)


def test_each_link_stands_beside_bare_dora() -> None:
    calm = [("41 kB", 0, 1_000_000 * number) for number in range(1, 101)]
    large = [("1 MB", 0, 5_000_000)]
    fast = [("fast", 0, number * 10**9) for number in range(3)]
    found = machines.results([("", 0, 1), *calm, *large, *fast])
    assert found["latency of 41 kB, median"] == 50.5
    assert found["latency of 41 kB, 99 of 100"] == 100
    assert found["latency of 1 MB, 99 of 100"] == 5
    assert found["throughput of 41 kB messages"] == 0.04096
    lives = {one: [found] for one in (machines.BARE, *machines.LINKS)}
    figures = list(machines.figures_of(lives))
    assert len(figures) == 2 * len(found)
    assert {tuple(one.values) for one in figures} == {("doractl", "dora")}


def test_a_few_messages_may_be_lost() -> None:
    messages = [one for size in SIZES for one in messages_of(size, 500, 100)]
    assert results(messages[10:])["latency of 8 B"] == 500
    with pytest.raises(AssertionError, match="80 of 200 messages of 8 bytes"):
        results(messages[120:])


@pytest.mark.parametrize(
    ("size", "written"), [(0, "0 B"), (512, "512 B"), (40_960, "41 kB"), (4_096_000, "4 MB")]
)
def test_sizes(size: int, written: str) -> None:
    assert name_of(size) == written


def test_quick_compares_ratios_not_times() -> None:
    slower = {"doractl": [500.0], "dora run": [1000.0], "circus": [1.0]}
    now = [replace(FIGURE, values=slower), replace(FIGURE, what="new")]
    assert compare(now, [FIGURE]) == [
        "start to all of 2 nodes ready, to dora run: 1.20 stored, 0.50 now, 0.42 ×"
    ]


@pytest.mark.parametrize(
    ("unit", "ours", "is_worse"),
    [
        *(("ms", 8.0, False), ("ms", 13.0, False), ("ms", 15.0, True)),
        *(("1/s", 15.0, False), ("1/s", 9.0, False), ("1/s", 7.0, True)),
    ],
)
def test_quick_says_what_became_worse_by_more_than_its_spread(
    unit: str, ours: float, is_worse: bool
) -> None:
    stored = Figure("it", unit, {"doractl": [8.0, 10.0, 14.0], "pm2": [10.0] * 3})
    now = replace(stored, values={"doractl": [ours], "pm2": [10.0]})
    (line,) = compare([now], [stored])
    assert line.endswith(WORSE) is is_worse


def test_readme_and_plots_are_what_the_stored_data_say() -> None:
    for path, text in make_files(read_records()).items():
        assert path.read_text() == text, f"{path.name}: run python -m benchmarks.report"

"""Who used the CPUs: from two samples of /proc."""

import pytest

from dora_systemd.decisions.resources.rivals import (
    MOST_RIVALS,
    ProcessTime,
    Rival,
    busiest,
    on_cpus,
    parse_stat,
)

FIELDS = "R 1 1 1 0 -1 4194304 90 0 0 0 120 30 0 0 20 0 1 0 77 4096 10"
TAIL = " ".join(["0"] * 14)
STAT = f"42 (a ) (b) {FIELDS} {TAIL} 3 0 0"


def test_a_line_of_stat() -> None:
    assert parse_stat(STAT) == ProcessTime("a ) (b", 150, 3)


@pytest.mark.parametrize("text", ["", "42 (x) R 1", "42 (x) " + "a " * 60, "no parentheses"])
def test_other_text(text: str) -> None:
    assert parse_stat(text) is None


def times(**ticks: int) -> dict[int, ProcessTime]:
    return {ord(name): ProcessTime(name, value, 0) for name, value in ticks.items()}


def test_the_busiest() -> None:
    before = times(a=100, b=0, c=7, d=50)
    now = times(a=112, b=25, c=8, d=99, e=400)
    found = busiest(before, now, 30.0, [ord("d")])
    assert found == [Rival(ord("b"), "b", 2500 / 30), Rival(ord("a"), "a", 40.0)]
    assert [str(one) for one in found] == ["process 98 (b, 83%)", "process 97 (a, 40%)"]
    assert busiest(now, before, 30.0, ()) == [], "a pid that another process has now"


def test_only_those_on_its_cpus() -> None:
    rivals = [Rival(pid, f"p{pid}", 90.0) for pid in range(6)]
    threads = {1: {2, 5}, 3: {0}, 4: {3}}
    assert [one.pid for one in on_cpus(rivals, threads, {2, 3})] == [1, 4]
    assert len(on_cpus(rivals, threads, ())) == MOST_RIVALS


def test_a_node_of_a_dataflow() -> None:
    rival = Rival(7, "python3", 55.55, "detector of robot")
    assert str(rival) == "process 7 (node detector of robot, 56%)"
    assert rival.values() == {
        "pid": 7,
        "command": "python3",
        "cpu_percent": 55.5,
        "node": "detector of robot",
    }

"""What groups wait for: read from control files, compared, put into words."""

from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup.strain import read_strain, read_waited
from dora_systemd.decisions.resources.usage import Strain, format_waits, waits

PSI = "some avg10=1.50 avg60=0.00 avg300=0.00 total=1500\n"
FULL = "full avg10=0.00 avg60=0.00 avg300=0.00 total=700\n"


def test_control_files(tmp_path: Path) -> None:
    (tmp_path / "cpu.pressure").write_text(PSI)
    (tmp_path / "memory.pressure").write_text(PSI + FULL)
    (tmp_path / "cpu.stat").write_text("usage_usec 9\nnr_periods 4\nthrottled_usec 33\n")
    (tmp_path / "memory.events").write_text("oom 2\noom_kill 3\n")
    assert read_strain(tmp_path) == Strain({"cpu": (1500, 0), "memory": (1500, 700)}, 33, 3)


def test_time_that_interrupts_took(tmp_path: Path) -> None:
    """irq.pressure has one line."""
    (tmp_path / "irq.pressure").write_text(FULL)
    assert read_strain(tmp_path).stalled == {"irq": (700, 700)}


def test_waits_for_a_cpu_in_the_last_minute(tmp_path: Path) -> None:
    assert read_waited(tmp_path) is None
    (tmp_path / "cpu.pressure").write_text(PSI.replace("avg60=0.00", "avg60=31.25") + FULL)
    assert read_waited(tmp_path) == 31.25


def test_a_group_that_has_gone(tmp_path: Path) -> None:
    assert read_strain(tmp_path / "node-x") == Strain()


@pytest.mark.parametrize(
    ("before", "window", "share"),
    [
        ({"io": (100, 0)}, 1000, 50.0),
        ({}, 1000, 60.0),
        ({"io": (900, 0)}, 1000, 0.0),
    ],
)
def test_waits(before: dict[str, tuple[int, int]], window: int, share: float) -> None:
    assert waits(Strain(before), Strain({"io": (600, 9)}), window) == {"io": share}


def test_no_window_no_waits() -> None:
    assert waits(Strain(), Strain({"io": (600, 9)}), 0) == {}


def test_only_what_matters_is_shown() -> None:
    assert format_waits({"cpu": 0.9, "memory": 12.4, "io": 60.0}) == "io 60% memory 12%"
    assert format_waits({}) == ""

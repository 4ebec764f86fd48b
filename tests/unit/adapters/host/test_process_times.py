"""CPU time of this process, from the real /proc and from one of files."""

import os
from pathlib import Path

from dora_systemd.adapters.host.process_times import read_delay, read_thread_cpus, read_times


def test_the_processes_of_this_machine() -> None:
    mine = read_times()[os.getpid()]
    assert mine.ticks >= 0
    assert read_thread_cpus(os.getpid()) <= frozenset(range(os.cpu_count() or 1))
    assert read_thread_cpus(os.getpid())


def test_delays_of_all_threads(tmp_path: Path) -> None:
    for thread, text in ((7, "9 1000 3\n"), (8, "9 500 3\n"), (9, "")):
        path = tmp_path / f"7/task/{thread}/schedstat"
        path.parent.mkdir(parents=True)
        path.write_text(text)
    assert read_delay([7, 99], tmp_path) == 1500


def test_no_processes(tmp_path: Path) -> None:
    (tmp_path / "7").mkdir()
    assert read_times(tmp_path) == {}
    assert read_thread_cpus(7, tmp_path) == frozenset()

"""python -m tests.history: histories of a seed, or of seeds for some hours, in the lab.

Exit status: 0 when every invariant holds, 1 when one is broken, which prints a shorter history as a
script.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.history.checker import Complaint, check
from tests.history.driver import Driver
from tests.history.generator import generate
from tests.history.history import History
from tests.history.report import Report
from tests.history.scene import PREAMBLE, Scene
from tests.history.script import format_script
from tests.history.shrink import shrink
from tests.history.steps import ALONE, Step
from tests.system.cells import run

HOUR = 3600.0


def run_history(steps: Sequence[Step]) -> History:
    """Carry out steps on this machine; nothing is left of them."""
    root = Path(tempfile.mkdtemp(prefix="history-", dir="/var/tmp"))
    driver = Driver(root)
    try:
        return driver.carry_out(steps)
    finally:
        driver.clean()
        shutil.rmtree(root)


def run_seed(seed: int, count: int, report: Report, can_shrink: bool, out: Path | None) -> bool:
    """One history; whether it broke nothing. out: where the records of one that did are kept."""
    steps, since = generate(seed, count, os.environ.get("LAB", ALONE)), time.time()
    history = run_history(steps)
    complaints = check(history)
    if complaints and out:
        keep_records(out / f"seed-{seed}", history, since)
    report.add(seed, history, complaints)
    print(report.line_of(seed, history, complaints), flush=True)
    if complaints and can_shrink:
        print(format_script(_shorter(steps, complaints), PREAMBLE.read_text()), flush=True)
    return not complaints


def keep_records(place: Path, history: History, since: float) -> None:
    """Write what a person needs: the script, the answers, and the journal of the machine."""
    script = format_script(history.steps, PREAMBLE.read_text())
    place.with_suffix(".sh").write_text(script)
    place.with_suffix(".answers").write_text(
        "\n".join(map(str, (*history.answers, *history.looks)))
    )
    journal = run("journalctl", "-q", "-o", "short-unix", f"--since=@{since:.6f}").stdout
    place.with_suffix(".journal").write_text(journal)


def _shorter(steps: Sequence[Step], complaints: Sequence[Complaint]) -> list[Step]:
    (name, _), *_ = Counter(one.invariant for one in complaints).most_common()

    def fails(some: list[Step]) -> bool:
        return any(one.invariant == name for one in check(run_history(some)))

    return shrink(steps, fails)


def main(arguments: Sequence[str]) -> int:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.history", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--shrink", action="store_true")
    parser.add_argument("--out", type=Path, help="keep the records of a broken history here")
    parser.add_argument("--project", type=Path, help="only make the projects of a script here")
    chosen = parser.parse_args(arguments)
    if chosen.project:
        Scene(chosen.project)
        return 0
    report, seed, is_good = Report(), chosen.seed, True
    until = time.monotonic() + chosen.hours * HOUR
    while True:
        try:
            is_good &= run_seed(seed, chosen.steps, report, chosen.shrink, chosen.out)
        except (AssertionError, OSError, subprocess.SubprocessError) as error:
            is_good = False  # the report of hours is worth more than one history
            report.complaints["the driver failed"] += 1
            print(f"seed {seed}: the driver failed: {error!r}", flush=True)
        seed += 1
        if time.monotonic() >= until:
            break
    print(report.format())
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

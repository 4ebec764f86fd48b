"""Which version of a file a node runs, if the file is saved while that is noted."""

import os
import time
from pathlib import Path

import pytest

from dora_systemd.runner.reload.versions import Versions


@pytest.mark.parametrize("is_saved", [True, False])
def test_a_file_that_is_saved_while_versions_are_noted_stays_unknown(
    tmp_path: Path, is_saved: bool
) -> None:
    """The paths come one after the other, from a search that takes its time."""
    path = tmp_path / "words.py"
    path.touch()
    begun_ns = time.time_ns()
    versions = Versions()

    def found() -> list[str]:
        if is_saved:
            while path.stat().st_ctime_ns <= begun_ns:  # the clock of files has ticks
                os.utime(path)
        return [str(path)]

    versions.add("sink", found(), begun_ns)
    assert versions.stale("sink", [str(path)]) == ({str(path)} if is_saved else set())

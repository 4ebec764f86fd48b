"""A trial ends, whatever kills the process that tries it."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.lab.pace import bound

_PROGRAM = """
import os, signal
from pathlib import Path
from dora_systemd.adapters.host.guard import guarded
place = Path({place!r})
with guarded(lambda: (place / "ended").touch()):
    {body}
(place / "left").touch()
"""


@pytest.mark.parametrize(
    ("body", "is_ended"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", True),
        ("os.killpg(0, signal.SIGKILL)", True),
        ("pass", False),
        ("raise SystemExit(3)", False),
    ],
)
def test_a_process_that_is_killed(tmp_path: Path, body: str, is_ended: bool) -> None:
    text = _PROGRAM.format(place=str(tmp_path), body=body)
    done = subprocess.run(
        [sys.executable, "-c", text], check=False, capture_output=True, start_new_session=True
    )
    end = time.monotonic() + bound(10)
    while is_ended and not (tmp_path / "ended").exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    assert (tmp_path / "ended").exists() == is_ended
    assert (tmp_path / "left").exists() == (done.returncode == 0)

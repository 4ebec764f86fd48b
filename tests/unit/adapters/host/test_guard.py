"""A trial ends, whatever kills the process that tries it."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.lab.pace import bound

_HOLDS = """
import fcntl, os, socket, sys, time
from pathlib import Path
from dora_systemd.adapters.host.guard import guarded
place = Path(sys.argv[1])
own, other = (os.open(place / name, os.O_RDWR | os.O_CREAT) for name in ("own", "other"))
for lock in (own, other):
    fcntl.flock(lock, fcntl.LOCK_EX)
here, there = socket.socketpair()
with guarded(lambda: time.sleep(1000), place / "own"):
    os.close(other)
    fcntl.flock(os.open(place / "other", os.O_RDWR), fcntl.LOCK_EX | fcntl.LOCK_NB)
    there.close()
    assert here.recv(1) == b""
    os.close(own)
    try:
        fcntl.flock(os.open(place / "own", os.O_RDWR), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print("held")
"""


def test_the_child_holds_nothing_but_its_lock(tmp_path: Path) -> None:
    """A gateway does several things at once: the locks and connections of others are not its."""
    command = [sys.executable, "-c", _HOLDS, str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=bound(60))
    assert (done.stdout, done.stderr) == ("held\n", "")


_KILL_BOTH = "kill_both"
"""As systemd does with the processes of a cgroup."""
_PROGRAM = """
import os, signal
from pathlib import Path
from dora_systemd.adapters.host.guard import guarded
place = Path({place!r})
(place / "lock").touch()
for one in (signal.SIGQUIT, signal.SIGHUP):  # a shell's "&" and nohup have them ignored
    signal.signal(one, signal.SIG_DFL)
def kill_both(number):
    children = Path(f"/proc/self/task/{{os.getpid()}}/children").read_text().split()
    assert len(children) == 1
    for pid in (*map(int, children), os.getpid()):
        os.kill(pid, number)
with guarded(lambda: (place / "ended").touch(), place / "lock"):
    {body}
(place / "left").touch()
"""


@pytest.mark.parametrize(
    ("body", "is_ended"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", True),
        ("os.killpg(0, signal.SIGKILL)", True),
        ("os.killpg(0, signal.SIGQUIT)", True),  # as Ctrl+\\ does
        *((f"{_KILL_BOTH}({one})", True) for one in ("signal.SIGQUIT", "signal.SIGABRT", 1, 15)),
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

"""Programs of others on a terminal of their own."""

import os
import pty
import select
import signal
import sys
import time

import pytest

from dora_systemd.trust.programs import own_account
from dora_systemd.trust.terminals import run_apart

ON_TTY = """
import os, sys
print("own", os.getsid(0) == os.getpid() == os.tcgetpgrp(0))
print("name", os.ttyname(1) != sys.argv[1], input("ask "))
if os.fork() == 0:
    for one in (1, 2, 15): __import__("signal").signal(one, 1)
    __import__("time").sleep(5)
    os._exit(0)
sys.exit(7)
"""


def on_a_terminal(script: str, typed: bytes, wait_for: bytes) -> tuple[str, int]:
    """What a terminal shows of `script`, that types when it sees `wait_for`, and how it ended."""
    child, master = pty.fork()
    if child == 0:
        command = (sys.executable, "-c", script, os.ttyname(0))
        os._exit(run_apart(command, {"PATH": os.defpath}, own_account()))
    seen, status, end = b"", None, time.monotonic() + 30
    while time.monotonic() < end:
        if select.select([master], [], [], 0.05)[0]:
            try:
                seen += os.read(master, 65536)
            except OSError:
                status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
                break
        if typed and wait_for in seen:
            os.write(master, typed)
            typed = b""
        if status is None and (ended := os.waitpid(child, os.WNOHANG))[0]:
            status = os.waitstatus_to_exitcode(ended[1])
            break
    os.close(master)
    assert status is not None, seen
    return seen.decode(), status


def test_it_has_a_terminal_of_its_own() -> None:
    begin = time.monotonic()
    seen, status = on_a_terminal(ON_TTY, b"word\n", b"ask")
    assert "own True" in seen
    assert "name True word" in seen
    assert status == 7
    assert time.monotonic() - begin < 4, "it waits for nobody that the program leaves behind"


def test_ctrl_c_is_for_the_program() -> None:
    script = "import signal, time\nprint('go', flush=True)\ntime.sleep(20)\n"
    seen, status = on_a_terminal(script, b"\x03", b"go")
    assert status == 128 + signal.SIGINT
    assert "KeyboardInterrupt" in seen


def test_pipes_stay_pipes(capfd: pytest.CaptureFixture[str]) -> None:
    command = (sys.executable, "-c", "import os\nprint(os.isatty(1))\nos.kill(os.getpid(), 9)")
    environment = {"PATH": os.defpath, "PYTHONUNBUFFERED": "1"}
    assert run_apart(command, environment, own_account()) == 128 + signal.SIGKILL
    assert capfd.readouterr().out == "False\n"


def test_what_is_no_program(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_apart(("/nowhere",), {}, own_account()) > 0
    assert "cannot run /nowhere: No such file" in capfd.readouterr().err

"""Children: their output and their time limit."""

import sys
import threading
import time

import pytest

from dora_systemd.adapters.host import process
from dora_systemd.errors import DoraSystemdError


def test_status_and_streams() -> None:
    done = process.run_command(["/bin/sh", "-c", "echo out; echo err >&2; exit 3"], 10)
    assert done == process.Completed(3, "out\n", "err\n")


def test_signal_is_a_negative_status() -> None:
    assert process.run_command(["/bin/sh", "-c", "kill -9 $$"], 10).status == -9


def test_output_is_bounded() -> None:
    done = process.run_command([sys.executable, "-c", "print('x' * 10_000_000)"], 30)
    assert done.status == 0
    assert len(done.stdout) == process.OUTPUT_LIMIT


def test_a_child_that_hangs_is_killed_with_its_children() -> None:
    begin = time.monotonic()
    with pytest.raises(DoraSystemdError, match=r"^cannot wait for"):
        process.run_command(["/bin/sh", "-c", "sleep 100 & sleep 100"], 0.2)
    assert time.monotonic() - begin < 90


def test_a_child_that_closes_its_streams_and_goes_on_is_killed_too() -> None:
    begin = time.monotonic()
    with pytest.raises(DoraSystemdError, match=r"^cannot wait for '/bin/sh'"):
        process.run_command(["/bin/sh", "-c", "exec >&- 2>&-; sleep 100"], 0.2)
    assert time.monotonic() - begin < 90


def test_what_cannot_be_run() -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot run /nowhere/x"):
        process.run_command(["/nowhere/x"], 1)


def test_calls_beside_each_other_take_the_time_of_one() -> None:
    meeting = threading.Barrier(2, timeout=30)
    calls = [process.beside(meeting.wait) for _ in range(2)]
    assert {call.result() for call in calls} == {0, 1}


def test_call_beside_raises_where_its_result_is_wanted() -> None:
    call = process.beside(lambda: process.run_command(["/nowhere/x"], 1))
    with pytest.raises(DoraSystemdError, match="cannot run /nowhere/x"):
        call.result()


def test_nothing_that_ends_a_call_beside_makes_its_result_wait_forever() -> None:
    call = process.beside(lambda: sys.exit(3))
    with pytest.raises(SystemExit):
        call.result(timeout=30)


def test_a_call_beside_goes_on_when_nobody_waits_for_it_any_more() -> None:
    """A task that is cancelled must not make its thread end with a traceback in the journal."""
    over = threading.Event()
    call = process.beside(over.wait)
    assert not call.cancel()
    over.set()
    assert call.result(timeout=30)

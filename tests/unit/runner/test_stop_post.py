"""What is said when the runner was killed."""

import os
import socket
import subprocess
import time
from pathlib import Path

import pytest

from dora_systemd.decisions.life.stop_budget import unit_timeout
from dora_systemd.runner.stop_post import (
    ALL_SECONDS,
    KILL_SECONDS,
    READ_SECONDS,
    kill_nodes,
    killed_by,
    main,
    out_of_memory,
    was_stopped_early,
    write_last_words,
)
from dora_systemd.values import SECOND
from tests.unit.checkout import CHECKOUT
from tests.unit.fakes.dialogue import OPTIONS

UUID = "550e8400-e29b-41d4-a716-446655440000"


@pytest.mark.parametrize(
    ("code", "status", "result", "reason", "cause"),
    [
        (
            "killed",
            "KILL",
            "signal",
            "the supervisor process was killed (SIGKILL)",
            "runner-killed",
        ),
        (
            "dumped",
            "ABRT",
            "watchdog",
            "the supervisor process hung and was killed by the watchdog",
            "watchdog",
        ),
        ("killed", "KILL", "timeout", "it did not start or stop in time and was killed", "timeout"),
        ("exited", "0", "success", "", "runner-killed"),
        ("exited", "1", "exit-code", "", "runner-killed"),
        ("", "", "", "", "runner-killed"),
    ],
)
def test_only_a_killed_runner_has_last_words(
    code: str, status: str, result: str, reason: str, cause: str
) -> None:
    environ = {"EXIT_CODE": code, "EXIT_STATUS": status, "SERVICE_RESULT": result}
    assert killed_by(environ) == (cause, reason)


def test_a_runner_that_was_killed_for_want_of_memory(tmp_path: Path) -> None:
    for name, held in (("supervisor", 1), ("node-a", 300), ("node-b", 500)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "memory.current").write_text(str(held << 20))
    assert out_of_memory(tmp_path) == {}
    (tmp_path / "supervisor/memory.events").write_text("oom_kill 1\n")
    details = {
        "reason": "the supervisor process was killed, out of memory; the node b held most, 500M",
        "cause": "out-of-memory",
    }
    assert out_of_memory(tmp_path) == {**details, "owner": "machine"}
    (tmp_path / "memory.events.local").write_text("oom 1\n")
    (tmp_path / "memory.max").write_text(str(600 << 20))
    limit = {"owner": "dataflow", "limit": str(600 << 20)}
    assert out_of_memory(tmp_path) == {**details, **limit}


def test_a_node_that_cannot_be_killed_is_left_to_systemd(tmp_path: Path) -> None:
    for name in ("node-a", "node-b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cgroup.kill").write_text("")
        (tmp_path / name / "cgroup.events").write_text("populated 1\nfrozen 0\n")
    began, used = time.monotonic(), time.process_time()
    kill_nodes(tmp_path, 0.3)
    assert 0.3 <= time.monotonic() - began < 3
    assert time.process_time() - used < 0.2, "it waits, it does not spin"
    assert (tmp_path / "node-b" / "cgroup.kill").read_text() == "1"


def test_all_of_it_fits_what_systemd_allows() -> None:
    assert (
        KILL_SECONDS + READ_SECONDS
        < ALL_SECONDS
        <= unit_timeout(OPTIONS._replace(grace=0)) / SECOND - 1
    )


def test_by_hand() -> None:
    assert main([]) == 0
    assert main(["robot", UUID]) == 0


def last_words(directory: Path, event: str = "dataflow-failed") -> list[bytes]:
    """The entries that are written for a runner that ran in `directory`."""
    path = directory / "socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as server:
        server.bind(str(path))
        details = {"reason": "killed"} if event == "dataflow-failed" else {}
        write_last_words("robot", UUID, directory, event, details, str(path))
        entries = []
        while True:
            try:
                entries.append(server.recv(10_000))
            except BlockingIOError:
                return entries


def test_last_words(tmp_path: Path) -> None:
    (tmp_path / "io").mkdir()
    fifo = tmp_path / "io" / "m1.inner.out"
    os.mkfifo(fifo)
    kept = os.open(fifo, os.O_RDWR)  # as systemd's store does
    os.write(kept, b"one\ntw")
    (tmp_path / "status.json").write_text("not a table")
    first, second, event = last_words(tmp_path)
    os.close(kept)
    assert b"MESSAGE=one\n" in first
    assert b"DORA_NODE=m1.inner\n" in first
    assert b"MESSAGE=tw\n" in second
    assert b"DORA_CUT=1\n" in second
    assert b"MESSAGE=Dataflow robot failed: killed\n" in event


def test_runtime_directory_is_empty(tmp_path: Path) -> None:
    (event,) = last_words(tmp_path)
    assert b"DORA_EVENT=dataflow-failed\n" in event


def test_a_stop_in_the_first_moments_is_recorded(tmp_path: Path) -> None:
    (event,) = last_words(tmp_path, "dataflow-stopped")
    assert b"MESSAGE=Dataflow robot was stopped\n" in event


@pytest.mark.parametrize(
    ("code", "result", "is_early"),
    [
        ("killed", "success", True),
        ("killed", "signal", False),
        ("exited", "success", False),
        ("dumped", "core-dump", False),
        ("", "", False),
    ],
)
def test_only_sigterm_before_the_handler_is_early(code: str, result: str, is_early: bool) -> None:
    environ = {"EXIT_CODE": code, "EXIT_STATUS": "TERM", "SERVICE_RESULT": result}
    assert was_stopped_early(environ) == is_early


def test_no_python_is_started_after_a_runner_that_ended_by_itself() -> None:
    script = ["/bin/sh", str(CHECKOUT / "dora_systemd/stoppost.sh"), "echo", "a  b"]
    for ended, printed in (("exited", ""), ("killed", "a  b\n"), ("dumped", "a  b\n")):
        done = subprocess.run(
            script, env={"EXIT_CODE": ended}, capture_output=True, text=True, check=True
        )
        assert done.stdout == printed


def test_what_is_damaged_costs_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "status.json").write_bytes(b"\xff")
    (tmp_path / "io").mkdir()
    (tmp_path / "io/a.place").write_bytes(b"x y z")
    log = tmp_path / "log"
    log.write_text("last\n")
    numbers = b"%020d %020d " % (log.stat().st_ino, 0)
    (tmp_path / "io/b.place").write_bytes(numbers + bytes(log))
    (tmp_path / "io/c.place").write_bytes(b"%020d %020d " % (log.stat().st_ino, -1) + bytes(log))
    line, event = last_words(tmp_path)
    assert b"MESSAGE=last\n" in line
    assert b"DORA_NODE=b\n" in line
    assert b"MESSAGE=Dataflow robot failed: killed\n" in event

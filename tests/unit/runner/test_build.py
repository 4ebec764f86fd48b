"""The program in the unit of a build."""

import contextlib
import json
import os
import shlex
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.decisions.life.refusal import parse_refusal
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.releases.build import BuildTask, format_task
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.build import Output, ToJournal, ToReader, build, main
from tests.unit.fakes.programs import make_program

PROGRAM = (sys.executable, "-m", "dora_systemd.runner.build")


class Journal(JournalSocket):
    """Keeps what it is sent."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[bytes] = []

    def send(self, entry: bytes) -> bool:
        self.entries.append(entry)
        return True


@pytest.fixture
def stdin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The pipe that doractl holds."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as ours, os.fdopen(writing, "w"):
        monkeypatch.setattr("sys.stdin", ours)
        yield


def output_of(*script: str, directory: Path) -> tuple[list[bytes], str]:
    """The journal, and the error of a build with these commands, "" for none."""
    commands = tuple(("sh", "-c", one) for one in script)
    task = BuildTask("robot", "uuid", "20260101T000000", str(directory), commands)
    journal, error = Journal(), ""
    try:
        build(task, Output(ToJournal(task, journal)))
    except DoraSystemdError as refusal:
        error = refusal.message
    return journal.entries, error


@pytest.mark.usefixtures("stdin")
def test_what_it_prints_is_in_the_journal(tmp_path: Path) -> None:
    entries, error = output_of("echo one; echo two >&2", "pwd", directory=tmp_path)
    assert error == ""
    texts = [entry.splitlines()[0] for entry in entries]
    assert texts == [b"MESSAGE=one", b"MESSAGE=two", b"MESSAGE=" + os.fsencode(tmp_path)]
    assert b"DORA_RELEASE=20260101T000000\n" in entries[0]


@pytest.mark.usefixtures("stdin")
def test_the_first_command_that_fails_is_the_last(tmp_path: Path) -> None:
    script = "echo 'a: stdout   all is lost'; echo 'a: INFO   x'; exit 3"
    _, error = output_of(script, "touch proof", directory=tmp_path)
    assert error.startswith("cannot build robot: ")
    assert error.endswith("; its last line: a: all is lost")
    assert not (tmp_path / "proof").exists()


UV = {
    "echo first; echo last; exit 3": "failed: exit code 3; its last line: last",
    "echo first; echo 'error: it is lost'; echo '  cause: nobody knows'; exit 2": (
        "cannot build robot: uv: it is lost: nobody knows"
    ),
}


@pytest.mark.usefixtures("stdin")
@pytest.mark.parametrize(("script", "expected"), UV.items())
def test_what_is_said_of_uv(tmp_path: Path, script: str, expected: str) -> None:
    uv = tmp_path / "uv"
    uv.write_text(f"#!/bin/sh\n{script}\n")
    uv.chmod(0o755)
    task = BuildTask("robot", "uuid", "20260101T000000", str(tmp_path), ((str(uv), "sync"),))
    with pytest.raises(DoraSystemdError) as caught:
        build(task, Output(ToJournal(task, Journal())))
    assert caught.value.message.endswith(expected)


@pytest.mark.usefixtures("stdin")
def test_a_process_in_the_background_is_not_waited_for(tmp_path: Path) -> None:
    entries, error = output_of("while sleep 0.1; do echo x; done & echo $!", directory=tmp_path)
    os.kill(int(entries[0].split(b"\n")[0].removeprefix(b"MESSAGE=")), 9)
    assert error == ""


@pytest.mark.usefixtures("stdin")
def test_lines_are_bounded(tmp_path: Path) -> None:
    entries, _ = output_of("head -c 300000 /dev/zero | tr '\\0' x", directory=tmp_path)
    assert len(entries) > 1
    assert max(map(len, entries)) < 100_000


def test_it_ends_with_doractl(tmp_path: Path) -> None:
    commands = [["sh", "-c", "touch begun; sleep 1000"]]
    names = {"name": "robot", "uuid": "u", "release": "r", "directory": str(tmp_path)}
    task = json.dumps({**names, "commands": commands})
    with subprocess.Popen((*PROGRAM, task), stdin=subprocess.PIPE) as child:
        while not (tmp_path / "begun").exists():
            assert child.poll() is None
        assert child.stdin
        child.stdin.close()
        assert child.wait(60) == 1


def test_it_ends_with_doractl_and_so_do_groups_of_dora(tmp_path: Path) -> None:
    """dora starts build commands in process groups of their own."""
    script = "import os,time; os.setpgid(0,0); open('begun','w').write(str(os.getpid())); "
    commands = ((sys.executable, "-c", f"{script}time.sleep(1000)"),)
    shell = f"{shlex.join(commands[0])} & trap '' INT; wait"
    task = BuildTask("robot", "", "", str(tmp_path), (("sh", "-c", shell),), is_shown=True)
    with subprocess.Popen((*PROGRAM, format_task(task)), stdin=subprocess.PIPE) as child:
        while not (tmp_path / "begun").exists() or not (tmp_path / "begun").read_text():
            assert child.poll() is None
        assert child.stdin
        child.stdin.close()
        assert child.wait(60) == 1
    stat = Path("/proc", (tmp_path / "begun").read_text(), "stat")
    assert not stat.exists() or ") Z" in stat.read_text()


def shown(directory: Path, script: str, name: str = "dora") -> tuple[str, str, int]:
    """What a build writes to both streams for a reader, and its exit status."""
    program = make_program(directory / name, script)
    task = BuildTask("x.yml", "", "", str(directory), ((program, "build"),), is_shown=True)
    with subprocess.Popen(
        (*PROGRAM, format_task(task)), stdin=-1, stdout=-1, stderr=-1, text=True
    ) as child:
        assert child.stdout and child.stderr
        return child.stdout.read(), child.stderr.read(), child.wait()


def test_what_a_reader_gets(tmp_path: Path) -> None:
    out, err, status = shown(tmp_path, "printf '\\033[1mone\\033[0m\\n'; echo two >&2")
    assert (out, err, status) == ("one\ntwo\n", "", 0)


DORA_FAILS = """echo 'a: stdout   all is lost'
echo '[ERROR]'
echo 'failed to build node `a`'
echo
echo 'Caused by:'
echo '   0: build command failed'
echo '   1: build command `make` returned exit status: 2'
exit 1"""


def test_a_node_that_fails_is_named_in_one_line(tmp_path: Path) -> None:
    out, err, status = shown(tmp_path, DORA_FAILS)
    assert out == "a: stdout   all is lost\n"
    expected = "node a: build command `make` returned exit status: 2; its last line: a: all is lost"
    refusal = parse_refusal(err.strip(), status)
    assert refusal and refusal.message == f"cannot build x.yml: {expected}"


def test_no_dora(tmp_path: Path) -> None:
    task = BuildTask("x.yml", "", "", str(tmp_path), ((f"{tmp_path}/dora", "build"),))
    with pytest.raises(DoraSystemdError, match=r"cannot run .*dora: No such file") as caught:
        build(task, Output(ToReader()))
    assert caught.value.code is ExitCode.NO_DORA


def test_no_line_is_lost_while_journald_restarts(tmp_path: Path) -> None:
    """It may take longer than a refused connection, which comes back at once."""
    path = tmp_path / "socket"
    journal = JournalSocket(str(path))
    output = Output(ToJournal(BuildTask("robot", "uuid", "r", "/", ()), journal))
    with (
        contextlib.closing(journal),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as server,
    ):
        threading.Timer(1, server.bind, [str(path)]).start()
        output.feed(b"one\n")
        assert server.recv(1000).startswith(b"MESSAGE=one\n")


@pytest.mark.parametrize("argv", [[], ["x"], ["5"], ["{}"], ['{"commands": 5}']])
def test_by_hand(argv: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == RunnerExit.BAD_DATAFLOW
    assert capfd.readouterr().err.startswith("cannot read what to build: ")

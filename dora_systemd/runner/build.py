"""Runs the commands of a build: `python3 -m dora_systemd.runner.build TASK`.

`doractl deploy` starts it in a unit of its own, as the user of the nodes, in their sandbox. It
writes what they print to the journal with the fields of the dataflow, and the last line of it to
STATUS=. Its standard input is a pipe that doractl holds: if that ends, doractl is gone, and so is
the build, for systemd kills what this program leaves.
"""

import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import PurePath

from dora_systemd.adapters.host.notify import send_status
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.decisions.life.refusal import format_refusal
from dora_systemd.decisions.life.states import RunnerExit
from dora_systemd.decisions.logs.fields import encode_entry
from dora_systemd.decisions.releases.build import (
    BuildTask,
    is_output,
    parse_task,
    parse_uv_error,
    shown_line,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.begin import nodes_environment
from dora_systemd.trust.programs import own_account, spawn
from dora_systemd.values import quoted

_CHUNK = 65536
_LONGEST = 8192
"""Bytes of a line; the rest is another line."""
_TAIL = 16384
"""Bytes of the output of a command in which its error is looked for."""
_LAST_CHUNKS = 64
_STATUS_SECONDS = 0.1
_JOURNAL_SECONDS = 5.0


class Gone(Exception):
    """doractl has ended."""


class Output:
    """What the build prints: to the journal, and its last line to STATUS=."""

    def __init__(self, task: BuildTask, journal: JournalSocket) -> None:
        self._journal = journal
        self._fields = {
            "PRIORITY": "6",
            "SYSLOG_IDENTIFIER": task.name,
            "DORA_DATAFLOW": task.uuid,
            "DORA_DATAFLOW_NAME": task.name,
            "DORA_RELEASE": task.release,
        }
        self._told = 0.0
        self._rest = b""
        self._is_dora = False
        self.tail = ""
        self.last = ""

    def begin(self, command: Sequence[str]) -> None:
        """Forget the last command's output. What dora itself prints is not its nodes' output."""
        self.tail = self.last = ""
        self._is_dora = not _is_uv(command)

    def feed(self, data: bytes) -> None:
        """Take what a command has printed; b"" for its end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if not data or len(self._rest) > _LONGEST:
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            self._take(line)

    def close(self) -> None:
        """Wait until journald has read all of it: it finds the unit by this process."""
        self._journal.wait_read(_JOURNAL_SECONDS)
        self._journal.close()

    def _take(self, line: bytes) -> None:
        text = line.decode("utf-8", "replace")
        self.tail = f"{self.tail}{text}\n"[-_TAIL:]
        if not (words := shown_line(text)):
            return
        self._write(line)
        if is_output(text) or not self._is_dora:
            self.last = words
        if time.monotonic() > self._told + _STATUS_SECONDS:
            send_status(words)
            self._told = time.monotonic()

    def _write(self, line: bytes) -> None:
        entry = encode_entry({"MESSAGE": line, **self._fields})
        deadline = time.monotonic() + _JOURNAL_SECONDS  # journald may restart
        while not self._journal.send(entry) and time.monotonic() < deadline:
            self._journal.wait_ready(1.0)


def run_command(command: Sequence[str], directory: str, output: Output) -> int:
    """Run a command to its end: its exit status. Raises Gone, OSError and DoraSystemdError."""
    output.begin(command)
    environment = {**nodes_environment(directory), "RUST_BACKTRACE": "0", "NO_COLOR": "1"}
    child = spawn(command, own_account(), environment, directory, stderr=subprocess.STDOUT)
    assert child.stdout
    end = os.pidfd_open(child.pid)
    with child.stdout:
        try:
            _follow(child.stdout.fileno(), end, output)
        finally:
            os.close(end)
    output.feed(b"")
    return child.wait()


def _follow(pipe: int, end: int, output: Output) -> None:
    """Take what a child prints until it ends. end: its pidfd. Raises Gone."""
    stdin = sys.stdin.fileno()
    watched = [stdin, end, pipe]
    # A process that it leaves may hold the pipe for ever: what counts is the end of the command.
    while end not in (ready := select.select(watched, [], [])[0]):
        if stdin in ready:
            raise Gone
        if not _read(pipe, output):
            watched.remove(pipe)
    for _ in range(_LAST_CHUNKS):
        if not select.select([pipe], [], [], 0)[0] or not _read(pipe, output):
            break


def _read(pipe: int, output: Output) -> bool:
    """Take what is in the pipe; whether there can be more."""
    data = os.read(pipe, _CHUNK)
    if data:
        output.feed(data)
    return bool(data)


def failure(task: BuildTask, command: Sequence[str], status: int, output: Output) -> str:
    """Why the build failed, in one line."""
    parse = parse_uv_error if _is_uv(command) else parse_dora_error
    said = parse(output.tail)
    reason = said or f"{quoted(' '.join(command))} failed: {exit_of(status)}"
    # uv's error has its last lines.
    last = "" if said and _is_uv(command) else output.last
    return f"cannot build {task.name}: {reason}" + (f"; its last line: {last}" if last else "")


def _is_uv(command: Sequence[str]) -> bool:
    return PurePath(command[0]).name == "uv"


def build(task: BuildTask, output: Output) -> None:
    """Run all commands. Raises DoraSystemdError for the first one that fails."""
    for command in task.commands:
        try:
            status = run_command(command, task.directory, output)
        except OSError as error:
            raise DoraSystemdError(f"cannot run {command[0]}: {error.strerror}") from error
        if status:
            raise DoraSystemdError(failure(task, command, status, output))


def main(argv: list[str]) -> int:
    """Carry out the task in `argv`; the exit status of a runner."""
    try:
        task = parse_task(" ".join(argv))
    except (ValueError, TypeError, KeyError):
        print("cannot read what to build: doractl deploy starts this program", file=sys.stderr)
        return RunnerExit.BAD_DATAFLOW
    output = Output(task, JournalSocket())
    try:
        build(task, output)
    except DoraSystemdError as error:
        send_status(format_refusal(error))
        return RunnerExit.BAD_DATAFLOW
    except Gone:
        return RunnerExit.FAILED
    finally:
        with suppress(OSError):
            output.close()
    return RunnerExit.OK


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Runs the commands of a build: `python3 -m dora_systemd.runner.build TASK`.

`doractl deploy` starts this program in a unit of its own, as the user of the nodes, in their
sandbox. The program writes the output of the commands to the journal with the fields of the
dataflow, and the last line to STATUS=. For `doractl build` it writes the lines to standard output,
and a refusal to standard error. Standard input is a pipe that doractl holds: at its end doractl is
gone, and the program stops the build. In a unit systemd also kills the processes that are left.
"""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import PurePath
from typing import Protocol

from dora_systemd.adapters.dora.command import INSTALL_HINT
from dora_systemd.adapters.host.notify import send_status
from dora_systemd.adapters.host.process_table import session_members
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.decisions.life.refusal import format_refusal, refusal_exit
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.logs.lines import encode_entry
from dora_systemd.decisions.releases.build import (
    BuildTask,
    is_output,
    parse_build_error,
    parse_task,
    parse_uv_error,
    shown_line,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.cell.begin import nodes_environment
from dora_systemd.terminal_text import without_sequences
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
_END_SECONDS = 2.0
_ERROR = "[ERROR]"
"""The line above the error of the dora command; lines of builds have the node in front."""


class Gone(Exception):
    """doractl has ended."""


class Sink(Protocol):
    """The receiver of the lines of a build."""

    def write(self, line: bytes, words: str) -> None:
        """Write a line. words: the line as it is shown. Raises Gone if nobody reads the output."""

    def close(self) -> None:
        """Wait until all lines are read. Raises OSError."""


class ToJournal:
    """Writes the lines to the journal, and the last one to STATUS=."""

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

    def write(self, line: bytes, words: str) -> None:
        """Write the line, also while journald restarts."""
        entry = encode_entry({"MESSAGE": line, **self._fields})
        deadline = time.monotonic() + _JOURNAL_SECONDS
        while not self._journal.send(entry) and time.monotonic() < deadline:
            self._journal.wait_ready(1.0)
        if time.monotonic() > self._told + _STATUS_SECONDS:
            send_status(words)
            self._told = time.monotonic()

    def close(self) -> None:
        """Wait until journald has read all lines: it finds their unit by this process."""
        self._journal.wait_read(_JOURNAL_SECONDS)
        self._journal.close()


class ToReader:
    """Writes the lines to standard output, without colours and without dora's own error at the end.

    The reader gets that error in one line.
    """

    def __init__(self) -> None:
        self._is_error = False

    def write(self, line: bytes, words: str) -> None:
        """Write the line at once."""
        self._is_error = self._is_error or words == _ERROR
        if self._is_error:
            return
        text = without_sequences(line.decode("utf-8", "replace")).rstrip()
        try:
            os.write(sys.stdout.fileno(), f"{text}\n".encode())
        except BrokenPipeError as error:
            raise Gone from error

    def close(self) -> None:
        """Do nothing: a line is read when it is written."""


class Output:
    """The output of a build."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._rest = b""
        self._is_dora = False
        self.tail = ""
        self.last = ""

    def begin(self, command: Sequence[str]) -> None:
        """Discard the last command's output."""
        self.tail = self.last = ""
        self._is_dora = not _is_uv(command)

    def feed(self, data: bytes) -> None:
        """Handle output of a command; b"" for its end."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if not data or len(self._rest) > _LONGEST:
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            self._take(line)

    def close(self) -> None:
        """Wait until all output is read. Raises OSError."""
        self._sink.close()

    def _take(self, line: bytes) -> None:
        text = line.decode("utf-8", "replace")
        self.tail = f"{self.tail}{text}\n"[-_TAIL:]
        if not (words := shown_line(text)):
            return
        self._sink.write(line, words)
        if is_output(text) or not self._is_dora:
            self.last = words


def run_command(command: Sequence[str], directory: str, output: Output) -> int:
    """Run a command; return its exit status. Raises Gone, OSError and DoraSystemdError."""
    output.begin(command)
    environment = {**nodes_environment(directory), "RUST_BACKTRACE": "0", "NO_COLOR": "1"}
    child = spawn(command, own_account(), environment, directory, stderr=subprocess.STDOUT)
    assert child.stdout
    end = os.pidfd_open(child.pid)
    with child.stdout:
        try:
            _follow(child.stdout.fileno(), end, output)
        except Gone:
            _end(child.pid, end)
            raise
        finally:
            os.close(end)
    output.feed(b"")
    return child.wait()


def _follow(pipe: int, end: int, output: Output) -> None:
    """Handle the output of a child until it ends. end: its pidfd. Raises Gone."""
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


def _end(leader: int, end: int) -> None:
    """End a child and its session, in which dora has other process groups. end: its pidfd."""
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGINT)
    select.select([end], [], [], _END_SECONDS)
    for one in session_members(leader):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(one, signal.SIGKILL)


def _read(pipe: int, output: Output) -> bool:
    """Handle what is in the pipe; return whether there can be more."""
    data = os.read(pipe, _CHUNK)
    if data:
        output.feed(data)
    return bool(data)


def failure(task: BuildTask, command: Sequence[str], status: int, output: Output) -> str:
    """Return why the build failed, in one line."""
    said = parse_uv_error(output.tail) if _is_uv(command) else _dora_error(output.tail)
    reason = said or f"{quoted(' '.join(command))} failed: {exit_of(status)}"
    # uv's error has its last lines.
    last = "" if said and _is_uv(command) else output.last
    return f"cannot build {task.name}: {reason}" + (f"; its last line: {last}" if last else "")


def _dora_error(printed: str) -> str:
    return parse_build_error(parse_dora_error(printed), printed)


def _is_uv(command: Sequence[str]) -> bool:
    return PurePath(command[0]).name == "uv"


def build(task: BuildTask, output: Output) -> None:
    """Run all commands. Raises DoraSystemdError for the first one that fails."""
    for command in task.commands:
        try:
            status = run_command(command, task.directory, output)
        except OSError as error:
            raise _no_program(task, command[0], error) from error
        if status:
            raise DoraSystemdError(failure(task, command, status, output))


def _no_program(task: BuildTask, program: str, error: OSError) -> DoraSystemdError:
    message = f"cannot build {task.name}: cannot run {program}: {error.strerror}"
    if PurePath(program).name == "dora":
        return DoraSystemdError(message, INSTALL_HINT, ExitCode.NO_DORA)
    return DoraSystemdError(message)


def main(argv: list[str]) -> int:
    """Carry out the task in `argv`; the exit status of a runner."""
    try:
        task = parse_task(" ".join(argv))
    except (ValueError, TypeError, KeyError):
        print("cannot read what to build: doractl deploy starts this program", file=sys.stderr)
        return RunnerExit.BAD_DATAFLOW
    output = Output(ToReader() if task.is_shown else ToJournal(task, JournalSocket()))
    try:
        build(task, output)
    except DoraSystemdError as error:
        if task.is_shown:
            print(format_refusal(error), file=sys.stderr)
        else:
            send_status(format_refusal(error))
        return refusal_exit(error)
    except Gone:
        return RunnerExit.FAILED
    finally:
        with suppress(OSError):
            output.close()
    return RunnerExit.OK


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

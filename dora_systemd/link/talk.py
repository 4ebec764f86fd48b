"""Passes lines between the runner of the head and ssh(1), which has a member at its other end.

The head does not trust a member: lines from the member are passed on whole and of bounded length.
"""

import os
import select
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress

from dora_systemd.decisions.machines.wire import (
    BEAT_SECONDS,
    MAX_LINE,
    Beat,
    FromLink,
    Lost,
    Message,
    format_message,
)
from dora_systemd.decisions.remote.stream import AfterMark

ANSWER_SECONDS = 30.0
"""Time for the first line of the member: for the login and doractl on a busy machine."""
_CHUNK = 1 << 16
_COMPLAINT = 4096
_END_SECONDS = 2.0
"""Time for a program to end on SIGTERM, before it is killed."""


class Program:
    """A running program with pipes, looked up in PATH. Leaving the context ends the program.

    input, output, errors: our ends of its pipes. Raises OSError if the program cannot be executed.
    Without subprocess, because that module would take a megabyte in each link.
    """

    def __init__(self, name: str, arguments: list[str]) -> None:
        theirs_in, self.input = os.pipe()
        self.output, theirs_out = os.pipe()
        self.errors, theirs_err = os.pipe()
        theirs = (theirs_in, theirs_out, theirs_err)
        try:
            actions = [(os.POSIX_SPAWN_DUP2, fd, number) for number, fd in enumerate(theirs)]
            self._pid = os.posix_spawnp(
                name,
                [name, *arguments],
                os.environ,
                file_actions=actions,
                setsigdef=[signal.SIGPIPE],
            )
        finally:
            for fd in theirs:
                os.close(fd)
        self.ended = os.pidfd_open(self._pid)
        self._status: int | None = None

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        for fd in (self.input, self.output, self.errors, self.ended):
            os.close(fd)

    def end(self) -> int:
        """End the program, if it still runs; return its exit status, negative for a signal."""
        if self._status is None:
            if not _waits(self.ended, 0):
                signal.pidfd_send_signal(self.ended, signal.SIGTERM)
            if not _waits(self.ended, _END_SECONDS):
                signal.pidfd_send_signal(self.ended, signal.SIGKILL)
            self._status = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._status


def read_now(fd: int, size: int = 1 << 16) -> bytes:
    """Read what is available without waiting; b"" for nothing, and at the end of the file."""
    os.set_blocking(fd, False)
    with suppress(BlockingIOError):
        return os.read(fd, size)
    return b""


def _waits(fd: int, seconds: float) -> bool:
    return bool(select.select([fd], [], [], seconds)[0])


class Talk:
    """One connection. rest: already received from the runner. on_turn: called every second.

    answer_seconds: time for the first line of the member. beat_seconds: interval of the heartbeats
    until that line.
    """

    def __init__(
        self,
        runner: socket.socket,
        ssh: Program,
        mark: str,
        rest: bytes,
        on_turn: Callable[[], None] = lambda: None,
        answer_seconds: float = ANSWER_SECONDS,
        beat_seconds: float = BEAT_SECONDS,
    ) -> None:
        self._answer_seconds, self._beat_seconds = answer_seconds, beat_seconds
        self._on_turn = on_turn
        self._runner, self._ssh = runner, ssh
        self._output, self._errors = AfterMark(mark), AfterMark(mark)
        self._complaint = b""
        self._rest = rest
        self._line = b""
        self._has_answered = False
        self._is_over = self._has_hung_up = False
        self._excuse = ""
        self._poll = select.poll()
        self._takers: dict[int, Callable[[], None]] = {
            runner.fileno(): self._from_runner,
            ssh.output: self._from_member,
            ssh.errors: self._from_errors,
            ssh.ended: self._end,
        }
        for fd in self._takers:
            self._poll.register(fd, select.POLLIN)
        # Until the member answers, ssh's pipe must not fill: poll only for the end of the runner.
        self._poll.register(runner, select.POLLRDHUP)

    def carry(self) -> None:
        """Pass lines in both directions until the runner or ssh has ended."""
        deadline = time.monotonic() + self._answer_seconds
        while not self._is_over:
            self._on_turn()
            for fd, _ in self._poll.poll(self._beat_seconds * 1000):
                self._take(fd)
            if not self._has_answered:
                self._wait_for_answer(deadline)

    def _take(self, fd: int) -> None:
        if fd == self._runner.fileno() and not self._output.is_open:
            self._hang_up()
        elif not self._is_over:
            self._takers[fd]()

    def _wait_for_answer(self, deadline: float) -> None:
        """Send a heartbeat for the member, which cannot yet; give up at the deadline."""
        self._send(format_message(Beat()))
        if time.monotonic() > deadline:
            self._excuse = f"no answer within {self._answer_seconds:g} s"
            self._end()

    def _end(self) -> None:
        self._is_over = True

    def _hang_up(self) -> None:
        """End the connection, because the runner has ended or begun another session."""
        self._has_hung_up = True
        self._end()

    def _from_runner(self) -> None:
        data = b""
        with suppress(OSError):
            data = self._runner.recv(_CHUNK)
        if data:
            self._to_member(data)
        else:
            self._hang_up()

    def _to_member(self, data: bytes) -> None:
        try:
            while data:
                data = data[os.write(self._ssh.input, data) :]
        except BrokenPipeError:  # ssh reports the reason on standard error
            self._poll.unregister(self._runner)

    def _from_member(self) -> None:
        data = os.read(self._ssh.output, _CHUNK)
        if not data:
            self._poll.unregister(self._ssh.output)
            return
        was_open = self._output.is_open
        shown = self._output.feed(data)
        if self._output.is_open and not was_open:
            self._poll.register(self._runner, select.POLLIN)
            self._to_member(self._rest)
        self._pass_on(shown)

    def _pass_on(self, data: bytes) -> None:
        whole, newline, self._line = (self._line + data).rpartition(b"\n")
        if len(self._line) > MAX_LINE:
            self._excuse = "it says something else than a member does"
            self._end()
        elif whole:
            self._has_answered = True
            self._send(whole + newline)

    def _from_errors(self) -> None:
        data = os.read(self._ssh.errors, _CHUNK)
        if data:
            self._complain(data)
        else:
            self._poll.unregister(self._ssh.errors)

    def _complain(self, data: bytes) -> None:
        self._complaint = (self._complaint + self._errors.feed(data))[-_COMPLAINT:]

    def _send(self, data: bytes) -> None:
        try:
            self._runner.sendall(data)
        except OSError:
            self._hang_up()

    def part_from(self, host: str, status: int) -> None:
        """Report to the runner why the connection has ended. status: of ssh."""
        while data := read_now(self._ssh.output):
            self._pass_on(self._output.feed(data))
        while data := read_now(self._ssh.errors):
            self._complain(data)
        word = self._last_word(host, status)
        if not self._has_hung_up:
            print(f"lost: {word.words}" if isinstance(word, Lost) else word.reason, flush=True)
        tell(self._runner, word)

    def _last_word(self, host: str, status: int) -> FromLink:
        # Imported late: most of the time nothing is lost.
        from dora_systemd.link.end_reason import last_word

        if self._excuse:
            return Lost(self._excuse)
        noise = self._errors.noise if not self._output.is_open else self._complaint
        said, complaint = (one.decode("utf-8", "replace") for one in (self._output.noise, noise))
        return last_word(host, status, self._output.is_open, said, complaint)


def tell(runner: socket.socket, message: Message) -> None:
    """Send the last message of a link to a runner, which may have ended."""
    with suppress(OSError):
        runner.sendall(format_message(message))

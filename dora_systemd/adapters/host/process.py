"""Child processes: run one to its end, read its output."""

import contextlib
import os
import select
import selectors
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from subprocess import Popen
from threading import Thread
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from dora_systemd.errors import DoraSystemdError, TimedOut
from dora_systemd.trust.programs import Account, spawn

if TYPE_CHECKING:
    from concurrent.futures import Future

T = TypeVar("T")

OUTPUT_LIMIT = 4 * 1024 * 1024
"""Bytes kept of each stream of a child."""
_CHUNK = 65536


class Completed(NamedTuple):
    """The result of a child: exit status (minus the signal number if killed) and output."""

    status: int
    stdout: str
    stderr: str


def run_command(
    command: Sequence[str],
    seconds: float,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
    account: Account | None = None,
) -> Completed:
    """Run a child until it exits, without input; keep OUTPUT_LIMIT bytes of each stream.

    environment, account: as for programs.spawn. After `seconds`, its whole process group is killed.
    Raises DoraSystemdError if it must not run, cannot run or takes too long.
    """
    deadline = time.monotonic() + seconds
    try:
        child = spawn(command, account, environment, directory)
    except OSError as error:
        raise DoraSystemdError(f"cannot run {command[0]}: {error.strerror}") from error
    with child:
        try:
            status, streams = read_child(child, deadline, command[0])
        except BaseException:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            raise
        return Completed(status, *(one.decode(errors="replace") for one in streams))


def read_child(
    child: "Popen[bytes]", deadline: float, command: str
) -> tuple[int, tuple[bytes, bytes]]:
    """Wait until a child exits; keep OUTPUT_LIMIT bytes of standard output and error, both pipes.

    deadline: seconds of the monotonic clock. Raises TimedOut; then the child is still there.
    """
    assert child.stdout and child.stderr
    output, errors = _collect((child.stdout.fileno(), child.stderr.fileno()), deadline, command)
    return _wait(child, deadline, command), (output, errors)


def beside(call: Callable[[], T]) -> "Future[T]":
    """Run a function in a thread, for calls that wait for child processes.

    Not a daemon thread, so that a child is reaped even if nothing uses the result.
    """
    # Imported late: it imports logging, and most commands need no thread.
    from concurrent.futures import Future

    future: Future[T] = Future()
    future.set_running_or_notify_cancel()  # a task that waits for it may be cancelled, but not this

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # whatever it is, result() must not wait forever
            future.set_exception(error)

    Thread(target=run).start()
    return future


def read_streams(streams: Sequence[int], seconds: float) -> list[bytes]:
    """Read pipes until their end, and close them. Raises DoraSystemdError after `seconds`."""
    try:
        return _collect(streams, time.monotonic() + seconds, "a check")
    finally:
        for fd in streams:
            os.close(fd)


def _collect(streams: Sequence[int], deadline: float, command: str) -> list[bytes]:
    """Read all streams until their end; drop what exceeds the limit."""
    kept = {fd: bytearray() for fd in streams}
    with selectors.DefaultSelector() as selector:
        for stream in kept:
            selector.register(stream, selectors.EVENT_READ)
        while selector.get_map():
            left = deadline - time.monotonic()
            if left <= 0:
                raise _hangs(command)
            for key, _ in selector.select(left):
                chunk = os.read(key.fd, _CHUNK)
                kept[key.fd] += chunk[: OUTPUT_LIMIT - len(kept[key.fd])]
                if not chunk:
                    selector.unregister(key.fd)
    return [bytes(one) for one in kept.values()]


def _wait(child: "Popen[bytes]", deadline: float, command: str) -> int:
    """Wait for the exit status of a child, which may run on after it has closed its streams."""
    poll, end = select.poll(), os.pidfd_open(child.pid)
    poll.register(end, select.POLLIN)
    try:
        if not poll.poll(max(deadline - time.monotonic(), 0) * 1000):
            raise _hangs(command)
    finally:
        os.close(end)
    return child.wait()


def _hangs(command: str) -> TimedOut:
    return TimedOut(f"cannot wait for {command!r} any longer: it hangs")

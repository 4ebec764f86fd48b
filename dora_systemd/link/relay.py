"""The member's end of a link: carries lines between ssh and the runner of the member.

`doractl member` replaces itself by this program, because doractl has loaded what a start needs, and
the relay runs as long as the dataflow. The relay gets the runner's connection as a file descriptor.

    python3 -I -S relay.py FD SECONDS

A head that sends nothing for SECONDS may be gone without any notice to ssh. Then the relay ends the
connection to the runner, which ends the part of the dataflow on this machine, and then the session,
whose ports would block the next session.

This is all of the program: imports only what Python itself has loaded, or takes no memory.
"""

import os
import select
import sys
import time

_CHUNK = 1 << 16
_KILL_SECONDS = 2


class LeaseOver(Exception):
    """The head has been silent for too long."""


class Relay:
    """The connections. runner: file descriptor. lease: seconds without a line from the head."""

    def __init__(self, runner: int, lease: float) -> None:
        self._runner, self._lease = runner, lease
        self._ends_at = time.monotonic() + lease
        for fd in (1, runner):
            os.set_blocking(fd, False)

    def carry(self) -> None:
        """Carry until either end has ended. Raises LeaseOver, and OSError."""
        while True:
            for fd in self._wait((0, self._runner), select.POLLIN):
                data = os.read(fd, _CHUNK)
                if not data:
                    _say_end(fd)
                    return
                if fd == 0 and b"\n" in data:
                    self._ends_at = time.monotonic() + self._lease
                self._write(1 if fd else self._runner, data)

    def _write(self, fd: int, data: bytes) -> None:
        """Write all data, but give up after the lease: the other side may not read any more."""
        while data:
            self._wait((fd,), select.POLLOUT)
            try:
                data = data[os.write(fd, data) :]
            except BlockingIOError:
                continue

    def _wait(self, fds: tuple[int, ...], event: int) -> list[int]:
        """The descriptors that are ready. Raises LeaseOver."""
        poll = select.poll()
        for fd in fds:
            poll.register(fd, event)
        found = poll.poll(max(self._ends_at - time.monotonic(), 0) * 1000)
        if not found:
            raise LeaseOver
        return [fd for fd, _ in found]


def main() -> int:
    """Carry until either end has ended; the exit status."""
    runner = int(sys.argv[1])
    os.set_inheritable(runner, False)
    try:
        Relay(runner, float(sys.argv[2])).carry()
    except LeaseOver:
        os.close(runner)
        _end_session()
    except OSError:
        pass
    return 0


def _say_end(fd: int) -> None:
    if fd:
        print("its supervisor process has ended", file=sys.stderr)


def _end_session() -> None:
    """End the sshd whose child this process is. The kernel refuses for an sshd of another user."""
    # Imported late: it takes half a megabyte, and is needed at the end only.
    import signal

    parent = os.getppid()
    try:
        session = os.pidfd_open(parent)
        # It is the parent now, so the descriptor is of no process that got its number later.
        if os.getppid() == parent and _is_sshd(parent):
            signal.pidfd_send_signal(session, signal.SIGTERM)
            select.select([session], [], [], _KILL_SECONDS)
            signal.pidfd_send_signal(session, signal.SIGKILL)
    except OSError:
        pass


def _is_sshd(pid: int) -> bool:
    comm = os.open(f"/proc/{pid}/comm", os.O_RDONLY)
    try:
        return os.read(comm, _CHUNK).startswith(b"sshd")
    finally:
        os.close(comm)


if __name__ == "__main__":
    sys.exit(main())

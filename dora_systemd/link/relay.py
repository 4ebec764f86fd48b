"""The member's end of a link: carries lines between ssh and the runner of the member.

`doractl member` executes this in its place, because that has loaded what a start needs, and this
runs as long as the dataflow. It gets the runner's connection as a file descriptor.

    python3 -E -P -m dora_systemd.link.relay FD SECONDS

If the head says nothing for SECONDS, it may be gone, and ssh need not know: nobody tells it. Then
the connection to the runner ends, which ends the part of the dataflow here, and this session ends,
because its ports would keep the next one out.
"""

import os
import select
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path

_CHUNK = 1 << 16
_KILL_SECONDS = 2


class LeaseOver(Exception):
    """The head has been silent for too long."""


def main() -> int:
    """Carry until either end has ended; the exit status."""
    runner = socket.socket(fileno=int(sys.argv[1]))
    runner.set_inheritable(False)
    lease = float(sys.argv[2])
    signal.signal(signal.SIGALRM, _on_alarm)
    signal.setitimer(signal.ITIMER_REAL, lease)
    try:
        _carry(runner, lease)
    except LeaseOver:
        runner.close()
        _end_session()
    return 0


def _on_alarm(*_: object) -> None:
    # Also in the middle of a write to a connection that nobody reads any more.
    raise LeaseOver


def _carry(runner: socket.socket, lease: float) -> None:
    poll = select.poll()
    for fd in (0, runner.fileno()):
        poll.register(fd, select.POLLIN)
    with suppress(OSError):
        while True:
            for fd, _ in poll.poll():
                data = os.read(fd, _CHUNK)
                if not data:
                    _say_end(fd)
                    return
                if fd:
                    _write(1, data)
                    continue
                if b"\n" in data:
                    signal.setitimer(signal.ITIMER_REAL, lease)
                _write(runner.fileno(), data)


def _say_end(fd: int) -> None:
    if fd:
        print("its supervisor process has ended", file=sys.stderr)


def _write(fd: int, data: bytes) -> None:
    while data:
        data = data[os.write(fd, data) :]


def _end_session() -> None:
    """End the sshd that this is a child of. It is of the same user, or the kernel refuses."""
    parent = os.getppid()
    with suppress(OSError):
        session = os.pidfd_open(parent)
        # It is the parent now, so the descriptor is of no process that got its number later.
        if os.getppid() == parent and _is_sshd(parent):
            signal.pidfd_send_signal(session, signal.SIGTERM)
            select.select([session], [], [], _KILL_SECONDS)
            signal.pidfd_send_signal(session, signal.SIGKILL)


def _is_sshd(pid: int) -> bool:
    return Path(f"/proc/{pid}/comm").read_text().startswith("sshd")


if __name__ == "__main__":
    sys.exit(main())

"""The member's end of a link, as a process."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from dora_systemd.decisions.machines.link_command import relay_command


@contextmanager
def relay(seconds: float) -> Iterator[tuple["subprocess.Popen[bytes]", socket.socket]]:
    runner, ours = socket.socketpair()
    command = relay_command(sys.executable, ours.fileno(), seconds)
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=pipe, pass_fds=[ours.fileno()]
    ) as child:
        ours.close()
        try:
            with runner:
                yield child, runner
        finally:
            child.kill()


def test_it_carries_both_ways_until_the_head_ends() -> None:
    with relay(60) as (child, runner):
        assert child.stdin
        assert child.stdout
        runner.sendall(b"ready\n")
        assert child.stdout.readline() == b"ready\n"
        child.stdin.write(b"beat\n")
        child.stdin.flush()
        assert runner.recv(100) == b"beat\n"
        child.stdin.close()
        assert runner.recv(100) == b""
        assert child.wait() == 0


def test_it_says_that_the_runner_has_ended() -> None:
    with relay(60) as (child, runner):
        runner.sendall(b"last\n")
        runner.shutdown(socket.SHUT_RDWR)
        assert child.stdout
        assert child.stderr
        assert child.stdout.read() == b"last\n"
        assert child.stderr.read() == b"its supervisor process has ended\n"


def test_a_silent_head_ends_the_part() -> None:
    """What has no end of line is no word."""
    with relay(0.3) as (child, runner):
        assert child.stdin
        child.stdin.write(b"x")
        child.stdin.flush()
        assert runner.recv(100) == b"x"
        assert runner.recv(100) == b""
        assert child.wait() == 0


def test_a_full_pipe_does_not_keep_it() -> None:
    """The head may be gone while a hostile node floods it."""
    with relay(0.5) as (child, runner):
        runner.settimeout(30)
        try:
            while True:
                runner.sendall(b"y" * 65536)
        except OSError as error:
            assert not isinstance(error, TimeoutError)
        assert child.wait() == 0

"""A link between a runner and a program in the place of ssh."""

import socket
import sys
from pathlib import Path
from threading import Thread

import pytest

from dora_systemd.decisions.machines.wire import (
    MAX_LINE,
    Beat,
    Lost,
    Message,
    Refused,
    Taken,
    Unreached,
    format_message,
    parse_message,
)
from dora_systemd.link.talk import Program, Talk

READY = b'{"type": "ready", "work": "/run/x"}\n'


class Far:
    """A member: what runs in the place of ssh, and a runner that hears it."""

    def __init__(self, script: str, said: bytes = b"", *seconds: float) -> None:
        """seconds: for the answer, and of a wait for it."""
        self._seconds = seconds
        self.runner, self.ours = socket.socketpair()
        self.heard = b""
        self.status = 0
        self._script, self._said = script, said

    def run(self) -> list[Message]:
        """What the runner hears until the end, without beats."""
        hearing = Thread(target=self._hear)
        hearing.start()
        with self.runner, self.ours, Program("sh", ["-c", self._script]) as ssh:
            one = Talk(self.ours, ssh, "mark", self._said, lambda: None, *self._seconds)
            one.carry()
            self.status = ssh.end()
            one.part_from("b", self.status)
            self.ours.shutdown(socket.SHUT_WR)
            hearing.join()
        messages = [parse_message(line) for line in self.heard.splitlines()]
        return [one for one in messages if not isinstance(one, Beat)]

    def _hear(self) -> None:
        while data := self.runner.recv(1 << 16):
            self.heard += data


def test_lines_after_the_mark_are_carried_both_ways() -> None:
    script = 'echo welcome; echo mark; read -r one; echo "$one"; read -r two; echo "$two"'
    far = Far(script, format_message(Refused("first")))
    far.runner.sendall(format_message(Refused("second")))
    assert far.run() == [Refused("first"), Refused("second"), Lost("it has ended")]


def test_half_a_line_is_none() -> None:
    far = Far('echo mark; printf \'{"type": "be\'')
    assert far.run() == [Lost("it has ended")]


def test_the_words_of_ssh() -> None:
    far = Far("echo 'ssh: connect to host b port 22: No route to host' >&2; exit 255")
    assert far.run() == [Lost("connect to host b port 22: No route to host")]


IN = "echo mark; echo mark >&2; "


@pytest.mark.parametrize(
    ("script", "reason", "tries"),
    [
        ("echo 'Host key verification failed.' >&2; exit 255", "Host key verification failed.", 0),
        ("echo 'a@b: Permission denied (publickey).' >&2; exit 255", "Permission denied", 0),
        (f"{IN}exit 127", "cannot find doractl on b", 0),
        (f"{IN}echo 'doractl: unknown option --x' >&2; exit 2", "on b has failed: unknown opt", 0),
        (
            f"{IN}echo 'doractl: cannot reach systemd' >&2; exit 7",
            "failed: cannot reach systemd",
            2,
        ),
        ("echo 'ssh: Could not resolve hostname b: Name' >&2; exit 255", "resolve hostname b", 1),
        ("echo 'This account is not available.'; exit 1", "This account is not available", 2),
    ],
)
def test_what_keeps_doractl_from_being_a_member(script: str, reason: str, tries: int) -> None:
    (found,) = Far(script).run()
    assert isinstance(found, Unreached)
    assert reason in found.reason
    assert found.tries == tries


@pytest.mark.parametrize(
    "words",
    [
        "Error: remote port forwarding failed for listen port 61000",
        "Could not request local forwarding.",
    ],
)
def test_a_port_that_is_taken(words: str) -> None:
    (found,) = Far(f"echo '{words}' >&2; exit 255").run()
    assert isinstance(found, Taken)
    assert found.reason == f"cannot forward a port to b: {words}"


def test_the_end_of_the_runner_ends_ssh(tmp_path: Path) -> None:
    far = Far(f"echo mark; echo '{READY.decode().strip()}'; echo $$ > {tmp_path}/pid; cat")
    closing = Thread(target=lambda: far.runner.shutdown(socket.SHUT_WR))
    closing.start()
    far.run()
    closing.join()
    assert far.status != 0 or not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists()


def test_a_line_without_an_end_is_not_kept() -> None:
    size = MAX_LINE + 100_000
    python = f"import sys; sys.stdout.write('mark\\n' + 'x' * {size}); sys.stdout.flush(); input()"
    far = Far(f'exec {sys.executable} -c "{python}"')
    assert far.run() == [Lost("it says something else than a member does")]


def test_a_member_that_says_nothing() -> None:
    far = Far("echo mark; exec cat", b"", 0.1, 0.05)
    assert far.run() == [Lost("no answer within 0.1 s")]
    assert far.heard.count(b"beat") > 1
